#!/usr/bin/env bash
# Times planish in C++ and pcl::MovingLeastSquares: compare/cpp.sh RADIUS_M FILE.pcd... [THREADS=2] [RUNS=20]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
work=$(mkdir -p "$here/../target/compare" && cd "$here/../target/compare" && pwd)
[ $# -ge 2 ] || { sed -n '2s/^# //p' "$0" >&2; exit 2; }
radius=$1
shift
dpkg -s libpcl-dev >/dev/null 2>&1 || { apt-get update -qq && apt-get install -y -qq --no-install-recommends g++ libpcl-dev >/dev/null; }
[ -d "$work/planish/include" ] || "$here/../crates/planish-c/install" "$work/planish"
version=$(echo /usr/include/pcl-*)
g++ -O3 -DNDEBUG -std=c++17 -fopenmp -w "$here/cpp.cpp" -o "$work/cpp" -I "$work/planish/include" -I "$version" -I /usr/include/eigen3 \
  -L "$work/planish/lib" -lplanish -lpcl_surface -lpcl_search -lpcl_kdtree -lpcl_octree -lpcl_io -lpcl_common -lboost_system
for file in "$@"; do
  echo "$file"
  LD_LIBRARY_PATH="$work/planish/lib" "$work/cpp" "$file" "$radius" "${THREADS:-2}" "${RUNS:-20}"
done
