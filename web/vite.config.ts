import { defineConfig } from "vite";

// The page works from any folder of any server, and offline.
export default defineConfig({
  root: "demo",
  base: "./",
  build: { outDir: "../dist-page", emptyOutDir: true, target: "es2022", modulePreload: false },
  worker: { format: "es" },
});
