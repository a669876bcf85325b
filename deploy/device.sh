# What an installation needs for the device that maps are drawn on; read by install.sh.
#
#   cpu     nothing more than AquaFlow itself
#   any     wgpu, for a GPU of any maker with a Vulkan driver; torch and priors stay on the processor
#   cuda    x86_64 with an NVIDIA GPU: PyPI's torch and onnxruntime-gpu, both for CUDA 13; gsplat,
#           compiled here
#   jetson  Orin with JetPack 6 (CUDA 12.6, Python 3.10): wheels of NVIDIA's Jetson AI Lab, which PyPI
#           does not have; gsplat, compiled here
#
# Where each comes from and what was never run: docs/gpu.md.

jetson_wheels=https://pypi.jetson-ai-lab.io/jp6/cu126/+f
jetson_torch_version=2.8.0
jetson_torch="torch @ $jetson_wheels/62a/1beee9f2f1470/torch-2.8.0-cp310-cp310-linux_aarch64.whl#sha256=62a1beee9f2f147076a974d2942c90060c12771c94740830327cae705b2595fc"
# 1.23.0 of the same index was built for numpy 1, and AquaFlow needs numpy 2.
jetson_onnxruntime="onnxruntime-gpu @ $jetson_wheels/d98/0b934b9a29c1a/onnxruntime_gpu-1.24.0-cp310-cp310-linux_aarch64.whl#sha256=d980b934b9a29c1a9d6f39751edd7662b69fadd75556a10ff363773a58ce0950"
orin_capability=8.7
# Compilers at once: the largest file took one 0.83 GB of memory (nvcc 13.0).
compile_jobs=2

# One word for the device, from what was asked for and from the build of torch that was chosen.
#   choose_device ASKED BUILD [ROOT], where ASKED is auto, cpu, any, cuda or jetson
choose_device() {
  local asked=$1 build=$2 release=${3:-}/etc/nv_tegra_release
  if [[ $asked != auto ]]; then
    echo "$asked"
  elif [[ $build == system && -f $release ]]; then
    echo jetson
  elif [[ $build == cuda ]]; then
    echo cuda
  else
    echo cpu
  fi
}

# The build of torch (see torch.sh) that a device asks for.
#   torch_of DEVICE PYTHON; a torch of the system's that reaches the Jetson's GPU stays
torch_of() {
  case $1 in
    cpu | any) echo cpu ;;
    cuda) echo cuda ;;
    jetson)
      if "$2" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())' 2>/dev/null; then
        echo system
      else
        echo jetson
      fi ;;
  esac
}

# AquaFlow's extras for a device: wgpu, or onnxruntime-gpu, which takes onnxruntime's place, as both are one module.
#   extras_for DEVICE PYTHON EXTRAS
extras_for() {
  local device=$1 python=$2 extras=,$3,
  if [[ $device == any ]]; then
    extras=,${3:+$3,}gpu-any,
  elif [[ $device == cuda ]] && ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    echo 'install.sh: onnxruntime-gpu for CUDA 13 needs Python 3.11; learned priors stay on the processor' >&2
  elif [[ $device != cpu ]]; then
    extras=${extras/,prior,/,prior-gpu,}
  fi
  extras=${extras#,}
  echo "${extras%,}"
}

# The compute capability that gsplat is compiled for, as in 8.7; nothing where it is not known.
#   capability_of DEVICE
capability_of() {
  case $1 in
    jetson) echo "$orin_capability" ;;
    cuda) nvidia-smi --query-gpu=compute_cap --format=csv,noheader 2>/dev/null | sort -u | paste -sd ';' ;;
  esac
}

# Compile gsplat's kernels into the environment; without them, maps are drawn on the processor.
# Its wheel would compile them at the first use, where the service may write nothing.
#   compile_gsplat VENV CAPABILITY PINS
compile_gsplat() {
  local venv=$1 capability=$2 pins=$3 nvcc
  if [[ -z $dry ]] && "$venv/bin/python" -c 'import torch; from gsplat import csrc' 2>/dev/null; then return; fi
  nvcc=$(command -v nvcc || compgen -G "${CUDA_HOME:-/usr/local/cuda}/bin/nvcc") || {
    echo 'install.sh: there is no nvcc: maps are drawn on the processor; install the CUDA toolkit that fits torch and run me again (docs/gpu.md)' >&2
    return
  }
  run "${pip[@]}" --constraint "$pins" setuptools ninja
  run env PATH="$venv/bin:$(dirname "$nvcc"):$PATH" TORCH_CUDA_ARCH_LIST="$capability" MAX_JOBS="$compile_jobs" \
    "${pip[@]}" --constraint "$pins" --force-reinstall --no-deps --no-build-isolation --use-pep517 --no-binary gsplat gsplat ||
    echo 'install.sh: gsplat did not compile: maps are drawn on the processor; its own words are above' >&2
}
