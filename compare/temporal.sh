#!/usr/bin/env bash
# Smooths simulated videos, or your own video, over time with planish and with other filters, and measures all results;
# see README.md in this folder.
# usage: temporal.sh [NAME ..]              simulated videos, such as still or moving-camera; all if no name is given
#        temporal.sh --input FOLDER FX,FY,CX,CY   a folder of depth images in millimetres
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare
planish=$project/target/release/planish
[ -x "$planish" ] || cargo build --release --quiet --manifest-path "$project/Cargo.toml" -p planish-cli
[ -x "$work/venv-temporal/bin/python" ] || python3 -m venv "$work/venv-temporal"
"$work/venv-temporal/bin/python" -m pip install --quiet --disable-pip-version-check 'numpy>=1.23' 'pillow>=10' 'pyrealsense2>=2.56,<3'
rm -rf "$work/temporal"
mkdir -p "$work/temporal"
ways=("rs" "rs, planish" "rs depth" "rs depth, planish" "exp. mean" "exp. mean, planish" "median 5" "median 5, planish")
results=()
for way in "${ways[@]}"; do results+=(--results "$work/temporal/$way"); done

if [ "${1:-}" = --input ]; then
    [ $# -eq 3 ] || { echo "usage: $0 --input FOLDER FX,FY,CX,CY" >&2; exit 2; }
    "$work/venv-temporal/bin/python" "$here/temporal.py" "$planish" "$work/temporal" "$2" "$3"
    exec "$planish" evaluate --sequence --input "$2" --camera "$3" "${results[@]}"
fi
[ $# -gt 0 ] || set -- still fixed-pattern flickering-holes slow-object fast-object thin-pole appearing-object moving-camera
for name in "$@"; do
    "$planish" evaluate --sequence "$name" --export "$work/temporal" > /dev/null 2>&1
    "$work/venv-temporal/bin/python" "$here/temporal.py" "$planish" "$work/temporal/ways" "$work/temporal/$name" 525,525,319.5,239.5
    for way in "${ways[@]}"; do
        mkdir -p "$work/temporal/$way"
        mv "$work/temporal/ways/$way" "$work/temporal/$way/$name"
    done
    rm -rf "$work/temporal/ways" "$work/temporal/${name:?}"
    "$planish" evaluate --sequence "$name" "${results[@]}"
done
