#!/usr/bin/env bash
# Counts the CPU engine's instructions with NEON, under QEMU, for frames and clouds; see README.md in this folder.
# usage: neon.sh FILE [FILE ..]
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 FILE [FILE ..]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
triple=aarch64-unknown-linux-gnu
packages=(gcc gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user)
dpkg -s "${packages[@]}" >/dev/null 2>&1 || { apt-get update -qq && apt-get install -y -qq --no-install-recommends "${packages[@]}" >/dev/null; } >&2
rustup target list --installed | grep -qx "$triple" || rustup target add "$triple" >&2
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
cargo build --quiet --release --locked --manifest-path "$project/Cargo.toml" -p planish-cli --no-default-features --target "$triple" >&2
planish=${CARGO_TARGET_DIR:-$project/target}/$triple/release/planish
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
gcc -shared -fPIC -O2 -o "$work/count.so" "$here/count_instructions.c"
run=(qemu-aarch64 -L /usr/aarch64-linux-gnu)
echo "\`compare/neon.sh $(for file in "$@"; do basename "$file"; done | xargs)\`, $("${run[@]}" "$planish" --version), $(rustc --version | cut -d' ' -f1,2), $(qemu-aarch64 --version | head -1 | cut -d' ' -f1-3)"
echo
python3 "$here/neon.py" "$work/count.so" "$planish" "$@"
