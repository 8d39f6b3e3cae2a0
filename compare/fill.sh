#!/usr/bin/env bash
# Fills holes of simulated frames with planish, librealsense and OpenCV, and measures all results; see README.md in
# this folder.
# usage: fill.sh WIDTH_PX SENSOR SEEDS
set -euo pipefail
[ $# -eq 3 ] || { echo "usage: $0 WIDTH_PX SENSOR SEEDS" >&2; exit 2; }
width=$1 sensor=$2 seeds=$3
source "$(dirname "$0")/fill_tools"
given=(--fill "$width" --sensor "$sensor" --seeds "$seeds")
"$planish" evaluate "${given[@]}" --export "$work/cut" > /dev/null 2>&1
# The other programs get planish's smoothed frames too, so that noise does not affect the comparison.
"$planish" smooth "$work/cut" "$work/smoothed" --camera 525,525,319.5,239.5 --sensor "$sensor" > /dev/null 2>&1
"$python" "$here/fill.py" "$work/cut" "$work/measured"
"$python" "$here/fill.py" "$work/smoothed" "$work/of planish"
"$python" "$here/fill_table.py" "$planish" "$work" "${given[@]}"
