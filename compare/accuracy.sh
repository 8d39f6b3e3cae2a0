#!/usr/bin/env bash
# Compares the surfaces of PCL, Open3D, OpenCV and planish on the same frames; see README.md in this folder.
# usage: accuracy.sh SEEDS [FRAME.pcd ..]: simulated frames, three per seed, are compared with their truth; real frames are measured by flatness.
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 SEEDS [FRAME.pcd ..]" >&2; exit 2; }
seeds=$1
shift
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare
radius=0.03
threads=2
"$here/install.sh" >&2
python=$work/venv/bin/python
planish=$project/target/release/planish
frames=$work/frames
rm -rf "$frames" "$work/results"
"$planish" evaluate --export "$frames" --seeds "$seeds" >/dev/null

others() { # NAME COMMAND..: runs the command on every frame, with FRAME and OUTPUT replaced by the paths of both files
  local name=$1 out=$work/results/$1
  shift
  mkdir -p "$out"
  for frame in "$frames"/*.pcd; do
    local command=("${@//FRAME/$frame}")
    "${command[@]//OUTPUT/$out/$(basename "$frame")}"
  done | awk '{ print $1 }' | sort -n | awk '{ t[NR] = $1 } END { print t[int((NR + 1) / 2)] }' >"$out.ms"
  "$planish" evaluate --results "$out" --seeds "$seeds" --json >"$out.json"
}
own() { # NAME OPTIONS..
  local out=$work/results/$1
  shift
  "$planish" evaluate --seeds "$seeds" --engine cpu --threads $threads --json "$@" >"$out.json"
  echo own >"$out.ms"
}

# PCL runs on one thread: with more, the order of its points does not match its indices.
others "PCL, 3 cm, order 1" "$work/pcl_mls" FRAME organized $radius 1 1 1 OUTPUT
others "PCL, 3 cm, order 2" "$work/pcl_mls" FRAME organized $radius 2 1 1 OUTPUT
export OMP_NUM_THREADS=$threads
others "Open3D smooth_mls, 3 cm, max_nn 30" "$python" "$here/open3d_mls.py" FRAME legacy $radius 30 1 OUTPUT
others "Open3D smooth_mls, 3 cm, all neighbours" "$python" "$here/open3d_mls.py" FRAME legacy $radius 0 1 OUTPUT
others "OpenCV bilateral on depth, 13x13" "$python" "$here/opencv_bilateral.py" FRAME 3 OUTPUT
own "planish paper" --preset paper
own "planish light" --preset light
own "planish default, edges off" --edges off
own "planish default" --preset default
own "planish strong" --preset strong
echo "\`compare/accuracy.sh $seeds $(for frame in "$@"; do basename "$frame"; done | xargs)\`, $("$planish" --version)"
echo
"$python" "$here/accuracy_table.py" "$work/results"

tiles() { # NAME OPTIONS..: prints the row of the current frame
  "$planish" evaluate --input "$frame" --json "${@:2}" | "$python" -c '
import json, sys
report = json.load(sys.stdin)
raw, smooth = report["raw"], report["smoothed"]
row = raw if sys.argv[1] == "raw" else smooth
print("| %s | %.3f | %.1f° | %.1f° | %.1f %% |"
      % (sys.argv[1], row["rms_mm"], row["normal_deg"], row["facet_deg"], 100 * row["speck_share"]))' "$1"
}
for frame in "$@"; do
  printf '\n%s:\n\n| | median RMS from the plane of a tile, mm | normals off the plane by | facets | facets over 30° |\n|---|---|---|---|---|\n' "$(basename "$frame")"
  tiles raw
  "$work/pcl_mls" "$frame" organized $radius 1 1 1 "$work/out.pcd" >/dev/null
  tiles "PCL, 3 cm, order 1" --results "$work/out.pcd"
  "$work/pcl_mls" "$frame" organized $radius 2 1 1 "$work/out.pcd" >/dev/null
  tiles "PCL, 3 cm, order 2" --results "$work/out.pcd"
  "$python" "$here/open3d_mls.py" "$frame" legacy $radius 0 1 "$work/out.pcd" >/dev/null
  tiles "Open3D smooth_mls, 3 cm, all neighbours" --results "$work/out.pcd"
  "$python" "$here/opencv_bilateral.py" "$frame" 1 "$work/out.pcd" >/dev/null
  tiles "OpenCV bilateral on depth, 13x13" --results "$work/out.pcd"
  tiles "planish paper" --preset paper
  tiles "planish default, edges off" --edges off
  tiles "planish default"
  tiles "planish strong" --preset strong
done
