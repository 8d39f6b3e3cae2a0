#!/usr/bin/env bash
# Cuts holes out of real depth images, fills them with planish, librealsense and OpenCV, and measures all results; see
# README.md in this folder.
# usage: fill_real.sh WIDTH_PX SENSOR FX,FY,CX,CY UNITS_PER_METRE IMAGE ..
set -euo pipefail
[ $# -ge 5 ] || { echo "usage: $0 WIDTH_PX SENSOR FX,FY,CX,CY UNITS_PER_METRE IMAGE .." >&2; exit 2; }
source "$(dirname "$0")/fill_tools"
"$python" "$here/fill_real.py" "$planish" "$work" "$@"
