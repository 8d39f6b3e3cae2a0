#!/usr/bin/env bash
# Compares outlier removal and voxel grids of PCL, Open3D and planish on the same points; see README.md in this folder.
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

fastest() { # operation and file
  grep "^$1 " "$2" | sort -k2,2n | head -1
}

echo "| frame, operation | PCL, ms | Open3D, ms | planish, ms | points left by each |"
echo "|---|---|---|---|---|"
for spec in "$@"; do
  IFS=: read -r frame radius voxel <<<"$spec"
  "$work/pcl_clean" "$frame" "$radius" "$voxel" 2>/dev/null >"$work/pcl.txt"
  "$work/venv/bin/python" "$here/open3d_clean.py" "$frame" "$radius" "$voxel" 2>/dev/null >"$work/open3d.txt"
  cat "$work/pcl.txt" "$work/open3d.txt" >&2
  { planish "$frame" statistical --statistical 20,2
    planish "$frame" radius --radius-outliers "$radius,5"
    planish "$frame" voxel --voxel "$voxel"; } >"$work/planish.txt"
  for operation in statistical radius voxel; do
    read -r _ pcl pcl_left pcl_way <<<"$(fastest "$operation" "$work/pcl.txt")"
    read -r _ open3d open3d_left open3d_way <<<"$(fastest "$operation" "$work/open3d.txt")"
    read -r _ ours ours_left <<<"$(fastest "$operation" "$work/planish.txt")"
    echo "| $(basename "$frame"), $operation | $pcl${pcl_way:+ ($pcl_way)} | $open3d ($open3d_way) | $ours | $pcl_left, $open3d_left, $ours_left |"
  done
done
