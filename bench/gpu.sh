#!/usr/bin/env bash
# Every figure of the GPU engine in BENCHMARK.md, on a machine that has nothing but the release binary, a GPU with its driver,
# and on Linux the Vulkan loader: bench/gpu.sh PLANISH [FRAME.pcd ..]
# Each setting is held against the f64 reference before it is timed; a wrong result ends the run.
set -euo pipefail
[ $# -ge 1 ] || { echo "usage: $0 PLANISH [FRAME.pcd ..]" >&2; exit 2; }
planish=$1
shift
"$planish" --version
"$planish" devices
if command -v nvidia-smi >/dev/null; then
  nvidia-smi --query-gpu=name,driver_version,pcie.link.gen.current,pcie.link.width.current,clocks.sm --format=csv,noheader
fi
for frame in "$@"; do
  echo
  "$planish" bench gpu --input "$frame"
done
echo
"$planish" bench gpu
