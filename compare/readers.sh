#!/usr/bin/env bash
# Reads every file of some folders with planish and with one or two other readers, and compares points, colours and fields.
# compare/readers.sh FOLDER ..
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
venv=$project/target/compare/venv-readers
if [ ! -x "$venv/bin/python" ]; then
  mkdir -p "$(dirname "$venv")" && python3 -m venv "$venv"
  "$venv/bin/pip" -q install 'laspy[lazrs]>=2.5,<3' 'plyfile>=1.1,<2' 'pypcd4>=1.5,<2' 'pye57>=0.4,<1' 'trimesh>=4,<5' pillow 'tifffile>=2024' 'open3d>=0.19,<0.20' 'numpy>=2'
fi
cargo build --release --quiet --manifest-path "$project/Cargo.toml"
"$venv/bin/python" "$here/readers.py" "$project/target/release/planish" "$@"
