#!/usr/bin/env bash
# Installs the requirements of the comparisons: PCL from Debian, Open3D and OpenCV from PyPI, the programs of this
# folder, and planish.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
project=$(dirname "$here")
work=$project/target/compare
mkdir -p "$work"

if ! dpkg -s libpcl-dev >/dev/null 2>&1; then
  apt-get update -qq && apt-get install -y -qq libpcl-dev g++ pkg-config >/dev/null
fi
if [ ! -x "$work/venv/bin/python" ]; then
  python3 -m venv "$work/venv"
  "$work/venv/bin/pip" -q install open3d-cpu==0.20.0 opencv-python-headless==5.0.0.93
fi
if [ ! "$work/pcl_mls" -nt "$here/pcl_mls.cpp" ]; then
  # No -march: Debian's library is built without it, and PCL's alignment depends on the flag.
  # shellcheck disable=SC2046
  g++ -O3 -DNDEBUG -fopenmp -w "$here/pcl_mls.cpp" -o "$work/pcl_mls" \
    $(pkg-config --cflags pcl_surface pcl_search pcl_filters pcl_io eigen3) -I/usr/include \
    -lpcl_surface -lpcl_search -lpcl_kdtree -lpcl_filters -lpcl_io -lpcl_common -lboost_system
fi
if [ ! "$work/pcl_clean" -nt "$here/pcl_clean.cpp" ]; then
  # shellcheck disable=SC2046
  g++ -O3 -DNDEBUG -fopenmp -w "$here/pcl_clean.cpp" -o "$work/pcl_clean" \
    $(pkg-config --cflags pcl_search pcl_filters pcl_io eigen3) -I/usr/include \
    -lpcl_search -lpcl_kdtree -lpcl_filters -lpcl_io -lpcl_common -lboost_system
fi
cargo build --release --quiet --manifest-path "$project/Cargo.toml"

