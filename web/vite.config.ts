import { defineConfig } from "vite";

// The page works from any folder of any server, and offline.
export default defineConfig({
  root: "demo",
  base: "./",
  build: { outDir: "../dist-page", emptyOutDir: true, target: "es2022", modulePreload: false },
  worker: { format: "es" },
  // Remove crossorigin, so that any server can serve the page, and the style applies even if it is opened as a file.
  plugins: [{ name: "no-crossorigin", transformIndexHtml: (html) => html.replaceAll(" crossorigin", "") }],
});
