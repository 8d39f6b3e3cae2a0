#!/usr/bin/env bash
# Compares PCL, Open3D and planish on frames without their grid, with all neighbours within a radius and degree 2; see README.md in this folder.
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 FRAME.pcd:RADIUS_M [FRAME.pcd:RADIUS_M ..]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare
threads=2
export OMP_NUM_THREADS=$threads
"$here/install.sh" >&2

cpu() { grep -m1 "$1" /proc/cpuinfo | cut -d: -f2 | xargs; }
echo "$(cpu 'model name') (family $(cpu 'cpu family')), $(nproc) cores; $threads threads; points and normals out"
echo
echo "| frame, radius | PCL, k-d tree, ms | Open3D, legacy, planes, ms | planish, instruction set, ms | PCL over planish | Open3D over planish |"
echo "|---|---|---|---|---|---|"
for pair in "$@"; do
  frame=${pair%:*} radius=${pair##*:}
  read -r pcl _ <<<"$("$work/pcl_mls" "$frame" kdtree "$radius" 2 $threads 1)"
  read -r open3d _ <<<"$("$work/venv/bin/python" "$here/open3d_mls.py" "$frame" legacy "$radius" 0 1 2>/dev/null)"
  "$project/target/release/planish" bench general --input "$frame" --radius "$radius" --threads $threads --every-simd --engine cpu --json |
    python3 -c 'import json, sys
for row in json.load(sys.stdin): print(row["engine"].replace(" ", ""), row["timing"]["ms"]["median"])' | while read -r level ms; do
    awk -v name="$(basename "$frame"), $radius m" -v pcl="$pcl" -v open3d="$open3d" -v level="$level" -v ms="$ms" \
      'BEGIN { printf "| %s | %.0f | %.0f | %s, %.1f | %.1f | %.1f |\n", name, pcl, open3d, level, ms, pcl / ms, open3d / ms }'
  done
done
