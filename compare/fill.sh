#!/usr/bin/env bash
# Fills holes of simulated frames with planish, librealsense and OpenCV, and measures all results; see README.md in
# this folder.
# usage: fill.sh WIDTH_PX SENSOR SEEDS
set -euo pipefail
[ $# -eq 3 ] || { echo "usage: $0 WIDTH_PX SENSOR SEEDS" >&2; exit 2; }
width=$1 sensor=$2 seeds=$3
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare/fill
planish=$project/target/release/planish
[ -x "$planish" ] || cargo build --release --quiet --manifest-path "$project/Cargo.toml" -p planish-cli
[ -x "$project/target/compare/venv-fill/bin/python" ] || python3 -m venv "$project/target/compare/venv-fill"
python=$project/target/compare/venv-fill/bin/python
"$python" -m pip install --quiet --disable-pip-version-check 'numpy>=1.23' 'opencv-python-headless>=4.9' 'pillow>=10' 'pyrealsense2>=2.56,<3'
rm -rf "$work"
mkdir -p "$work"
given=(--fill "$width" --sensor "$sensor" --seeds "$seeds")
"$planish" evaluate "${given[@]}" --export "$work/cut" > /dev/null 2>&1
# The other programs get planish's smoothed frames too, so that noise does not affect the comparison.
"$planish" smooth "$work/cut" "$work/smoothed" --camera 525,525,319.5,239.5 --sensor "$sensor" > /dev/null 2>&1
"$python" "$here/fill.py" "$work/cut" "$work/measured"
"$python" "$here/fill.py" "$work/smoothed" "$work/of planish"
"$python" "$here/fill_table.py" "$planish" "$work" "${given[@]}"
