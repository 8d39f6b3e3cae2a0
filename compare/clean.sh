#!/usr/bin/env bash
# PCL, Open3D and planish: outliers and voxels on the same points; see README.md beside this.
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 FRAME.pcd:RADIUS_M:VOXEL_M [..]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare
export OMP_NUM_THREADS=2
"$here/install.sh" >&2

planish() { # frame, operation and its option
  for _ in 1 2 3 4 5; do
    "$project/target/release/planish" clean "$1" "$work/clean.pcd" "$3" "$4" --json 2>/dev/null
  done | python3 -c 'import json, statistics, sys
reports = [json.loads(line) for line in sys.stdin]
print(sys.argv[1], "%.2f" % statistics.median(report["clean_ms"] for report in reports), reports[0]["points_out"])' "$2"
}

echo "| frame, operation | PCL, ms | Open3D, ms | planish, ms | points left by each |"
echo "|---|---|---|---|---|"
for spec in "$@"; do
  IFS=: read -r frame radius voxel <<<"$spec"
  "$work/pcl_clean" "$frame" "$radius" "$voxel" 2>/dev/null >"$work/pcl.txt"
  "$work/venv/bin/python" "$here/open3d_clean.py" "$frame" "$radius" "$voxel" 2>/dev/null >"$work/open3d.txt"
  { planish "$frame" statistical --statistical 20,2
    planish "$frame" radius --radius-outliers "$radius,5"
    planish "$frame" voxel --voxel "$voxel"; } >"$work/planish.txt"
  paste -d' ' "$work/pcl.txt" "$work/open3d.txt" "$work/planish.txt" | while read -r name a b _ c d _ e f; do
    echo "| $(basename "$frame"), $name | $a | $c | $e | $b, $d, $f |"
  done
done
