#!/usr/bin/env bash
# Measures how close PCL, Open3D and planish bring noisy clouds of known shapes to the surface; see README.md in this folder.
# usage: denoise.sh POINTS[,POINTS ..] [MESH ..]: simple shapes, and your own meshes, such as the test meshes of learned denoisers.
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 POINTS[,POINTS ..] [MESH ..]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare
"$here/install.sh" >&2
echo "\`compare/denoise.sh $1 $(for mesh in "${@:2}"; do basename "$mesh"; done | xargs)\`, $("$project/target/release/planish" --version)"
echo
exec "$work/venv/bin/python" "$here/denoise.py" "$project/target/release/planish" "$work/pcl_mls" "$work/denoise" "$@"
