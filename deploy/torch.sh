# Which build of torch an installation gets; read by install.sh and hashes.sh.
#
#   cpu     PyTorch's wheels for processors, some 200 MB to download; never the default ones of PyPI,
#           which bring 4.8 GB of CUDA along on x86_64 and on aarch64
#   cuda    PyPI's wheel, with its CUDA libraries
#   system  the torch that the system's Python has; on a Jetson, NVIDIA's for JetPack
#   jetson  that wheel, installed by install.sh (device.sh)

torch_cpu_index=https://download.pytorch.org/whl/cpu

# The processor and pointer size of an interpreter, as in 'aarch64 64'.
interpreter_kind() {
  "$1" -c 'import platform, struct; print(platform.machine(), 8 * struct.calcsize("P"))'
}

# One word for the build that fits this machine; the reason goes to stderr.
#   choose_torch PYTHON ASKED [ROOT], where ASKED is auto, cpu, cuda or system
choose_torch() {
  local python=$1 asked=$2 release=${3:-}/etc/nv_tegra_release
  local has_gpu='import sys, torch; sys.exit(not torch.cuda.is_available())'
  if [[ $asked != auto ]]; then
    echo "torch: $asked, as asked" >&2
    echo "$asked"
  elif [[ -f $release ]] && "$python" -c "$has_gpu" 2>/dev/null; then
    echo "torch: the system's, which reaches the Jetson's GPU" >&2
    echo system
  elif [[ -f $release ]]; then
    echo "torch: for the processor; $python has no torch that reaches the Jetson's GPU; --device jetson fetches one (docs/gpu.md)" >&2
    echo cpu
  elif nvidia-smi --list-gpus 2>/dev/null | grep -q GPU; then
    echo 'torch: with CUDA (4.8 GB), as nvidia-smi names a GPU; --torch cpu avoids it' >&2
    echo cuda
  else
    echo 'torch: for the processor, as there is no NVIDIA GPU here' >&2
    echo cpu
  fi
}

# Make a copy of constraints.txt ask for that build and no other.
#   pin_torch BUILD PYTHON PINS
pin_torch() {
  local build=$1 python=$2 pins=$3
  case $build in
    # '+cpu' is in PyTorch's own index only: without that index pip fails instead of taking CUDA.
    cpu) sed -i 's/^torch==\([0-9.]*\).*/torch==\1+cpu/' "$pins" ;;
    cuda) ;;
    jetson) sed -i "s/^torch==.*/torch==$jetson_torch_version/" "$pins" ;;
    system)
      sed -i '/^torch==/d; /^numpy==/d' "$pins"
      "$python" -c 'import torch; print(f"torch=={torch.__version__}")' >>"$pins" ;;
    *) echo "there is no torch build '$build'; choose auto, cpu, cuda or system" >&2; return 1 ;;
  esac
}
