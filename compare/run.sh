#!/usr/bin/env bash
# Compares PCL, Open3D and planish on the same frames in one run; see README.md in this folder.
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 FRAME.pcd [FRAME.pcd ..]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare
radius=0.03
threads=2
"$here/install.sh" >&2

planish() { # FILE ENGINE RUNS PRESET: milliseconds and points
  "$project/target/release/planish" smooth "$1" "$work/out.pcd" --preset "$4" --engine "$2" --threads $threads \
    --repeat "$3" --json | python3 -c '
import json, sys
report = json.load(sys.stdin)
status = report["status"]
print(report["smooth_ms"]["median"], status["degenerate"] + status["plane"] + status["polynomial"])'
}

cpu() { grep -m1 "$1" /proc/cpuinfo | cut -d: -f2 | xargs; }
echo "\`compare/run.sh $(for frame in "$@"; do basename "$frame"; done | xargs)\`"
echo
echo "$(cpu 'model name') (family $(cpu 'cpu family')), $(nproc) cores; $threads threads, radius $radius m; $("$project/target/release/planish" --version)"
for frame in "$@"; do
  echo
  echo "$(basename "$frame"):"
  echo
  echo "| system | ms, median | points out | times planish paper, cpu |"
  echo "|---|---|---|---|"
  read -r base base_points <<<"$(planish "$frame" cpu 101 paper)"
  row() { # NAME MS POINTS
    awk -v name="$1" -v ms="$2" -v points="$3" -v base="$base" \
      'BEGIN { printf "| %s | %.1f | %d | %.1f |\n", name, ms, points, ms / base }'
  }
  for search in organized kdtree; do
    row "PCL MovingLeastSquares, degree 3, $search" $("$work/pcl_mls" "$frame" $search $radius 3 $threads 3)
  done
  for neighbours in 30 0; do
    for api in legacy tensor; do
      row "Open3D $api smooth_mls (plane), $([ $neighbours = 0 ] && echo all || echo at most $neighbours) neighbours" \
        $(OMP_NUM_THREADS=$threads "$work/venv/bin/python" "$here/open3d_mls.py" "$frame" $api $radius $neighbours 3)
    done
  done
  row "planish paper, reference (f64)" $(planish "$frame" reference 5 paper)
  row "planish paper, cpu" "$base" "$base_points"
  row "planish default, cpu" $(planish "$frame" cpu 101 default)
done
