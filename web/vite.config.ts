import { defineConfig } from "vite";

// The page works from any folder of any server, and offline.
export default defineConfig({
  root: "demo",
  base: "./",
  build: { outDir: "../dist-page", emptyOutDir: true, target: "es2022", modulePreload: false },
  worker: { format: "es" },
  // For servers of any origin, and so that the style applies to the page as a file.
  plugins: [{ name: "no-crossorigin", transformIndexHtml: (html) => html.replaceAll(" crossorigin", "") }],
});
