#!/usr/bin/env bash
# Counts the CPU engine's instructions for frames and clouds, by preset and stage; see README.md in this folder.
# usage: instructions.sh FILE [FILE ..]
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 FILE [FILE ..]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
command -v valgrind >/dev/null || { apt-get update -qq && apt-get install -y -qq --no-install-recommends valgrind >/dev/null; } >&2
cargo build --quiet --release --locked --manifest-path "$project/Cargo.toml" -p planish-cli --no-default-features >&2
planish=${CARGO_TARGET_DIR:-$project/target}/release/planish
echo "\`compare/instructions.sh $(for file in "$@"; do basename "$file"; done | xargs)\`, $("$planish" --version), $(rustc --version | cut -d' ' -f1,2)"
echo
exec python3 "$here/instructions.py" "$planish" "$@"
