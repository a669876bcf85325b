#!/usr/bin/env bash
# Install AquaFlow as a service. Safe to run again: an existing installation is updated.
#
#   sudo deploy/install.sh [options]
#     --config FILE      the vehicle's YAML (default: keep /etc/aquaflow/aquaflow.yaml, or the example)
#     --python PROGRAM   interpreter of the environment (default: python3)
#     --wheelhouse DIR   install from these wheels only, without a network
#     --extras LIST      optional parts (default: prior,telemetry,recording)
#     --device DEVICE    cpu, any, cuda or jetson: where maps are drawn and learned priors run (default:
#                        auto, cuda where a GPU answers, jetson where torch reaches a Jetson's, or cpu)
#     --torch BUILD      cpu, cuda, or system for the torch that --python has (default: the device's)
#     --no-start         install, but neither enable nor start
#     --root DIR         install under DIR instead of / (for images and tests); starts nothing
#     --dry-run          say what would be installed from where, and do nothing
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
checkout=$(dirname "$here")
config='' python=python3 wheelhouse='' extras=prior,telemetry,recording
torch=auto device=auto start=yes root='' dry=''

# shellcheck source=deploy/torch.sh
source "$here/torch.sh"
# shellcheck source=deploy/device.sh
source "$here/device.sh"
fail() { echo "install.sh: $*" >&2; exit 1; }
run() { if [[ -n $dry ]]; then echo "+ $*"; else "$@"; fi; }

while (($#)); do
  case $1 in
    --config) config=${2:?--config needs a file}; shift ;;
    --python) python=${2:?--python needs a program}; shift ;;
    --wheelhouse) wheelhouse=${2:?--wheelhouse needs a folder}; shift ;;
    --extras) extras=${2?--extras needs a list}; shift ;;
    --device) device=${2:?--device needs a device}; shift ;;
    --torch) torch=${2:?--torch needs a build}; shift ;;
    --no-start) start='' ;;
    --root) root=${2:?--root needs a folder}; start=''; shift ;;
    --dry-run) dry=yes ;;
    -h | --help) sed -n '2,17s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) fail "unknown option $1; see --help" ;;
  esac
  shift
done

case $torch in auto | cpu | cuda | system) ;; *) fail "--torch is auto, cpu, cuda or system, not $torch" ;; esac
case $device in
  auto | cpu | any | cuda | jetson) ;;
  *) fail "--device is auto, cpu, any, cuda or jetson, not $device" ;;
esac
[[ -n $dry ]] || ((EUID == 0)) || fail 'run me as root: sudo deploy/install.sh'
[[ -z $config || -f $config ]] || fail "there is no config at $config"
[[ -z $wheelhouse || -d $wheelhouse ]] || fail "there is no wheelhouse at $wheelhouse"

# --- the interpreter ------------------------------------------------------------------------------
command -v "$python" >/dev/null || fail "$python is not installed"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' || fail "$python is older than 3.10"
kind=$(interpreter_kind "$python")
case $kind in
  'x86_64 64' | 'aarch64 64') ;;
  *) fail "AquaFlow needs a 64-bit system, x86_64 or aarch64, not '$kind', which $python is; a BlueROV2 with BlueOS's armv7 image needs a 64-bit image or a second computer" ;;
esac
"$python" -c 'import venv, ensurepip' 2>/dev/null || fail "$python has no venv: apt-get install python3-venv"
base=$("$python" -c 'import sys; print(sys.base_prefix)')
case $(readlink -f "$base")/ in
  # The unit hides these folders, and would end with status 203/EXEC.
  /home/* | /root/* | /run/user/* | /tmp/*)
    fail "$python lives in $base, which the service cannot reach; give --python /usr/bin/python3" ;;
esac

# --- device ---------------------------------------------------------------------------------------
if [[ $device == auto || $torch != auto ]]; then
  build=$(choose_torch "$python" "$torch")
  device=$(choose_device "$device" "$build")
else
  build=$(torch_of "$device" "$python")
fi
if [[ $build == jetson ]]; then
  "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 10))' ||
    fail "the wheels for JetPack 6 are for Python 3.10, which $python is not; see docs/gpu.md"
fi
extras=$(extras_for "$device" "$python" "$extras")
# Neither a wheelhouse nor a list of hashes holds what a GPU needs beyond torch.
offline=''
if [[ -n $wheelhouse || -f $here/requirements.lock ]]; then offline=yes; fi
if [[ ($device == cuda || $device == jetson) && -n $offline ]]; then
  echo 'install.sh: onnxruntime-gpu and gsplat are not in a wheelhouse: priors and maps stay on the processor' >&2
  device=cpu extras=${extras/prior-gpu/prior}
fi
echo "install.sh: device $device, torch $build, extras ${extras:-none}"

# --- user and groups ------------------------------------------------------------------------------
if [[ -z $root && -z $dry ]]; then
  getent group aquaflow >/dev/null || groupadd --system aquaflow
  getent passwd aquaflow >/dev/null || useradd --system --gid aquaflow --no-create-home \
    --home-dir /var/lib/aquaflow --shell /usr/sbin/nologin aquaflow
  for group in video render dialout plugdev; do
    if getent group "$group" >/dev/null; then usermod --append --groups "$group" aquaflow; fi
  done
fi

# --- program --------------------------------------------------------------------------------------
program=$root/opt/aquaflow
system_site=''
if [[ $build == system ]]; then
  "$python" -c 'import torch' 2>/dev/null || fail "$python has no torch to use; install one, or give --torch cpu"
  system_site=yes
fi
run install -d -m 0755 "$program" "$program/share"
if [[ ! -x $program/venv/bin/python ]]; then
  run "$python" -m venv ${system_site:+--system-site-packages} "$program/venv"
fi
pip=("$program/venv/bin/python" -m pip --disable-pip-version-check --no-cache-dir install --quiet)
if [[ -n $wheelhouse ]]; then
  pip+=(--no-index --find-links "$wheelhouse")
elif [[ $build == cpu ]]; then
  pip+=(--extra-index-url "$torch_cpu_index")
fi
source=$checkout
if compgen -G "$wheelhouse/aquaflow-*.whl" >/dev/null; then
  source=$(compgen -G "$wheelhouse/aquaflow-*.whl" | sort -V | tail -n 1)
fi
pins=$program/share/constraints.txt
run install -m 0644 "$checkout/constraints.txt" "$pins"
run pin_torch "$build" "$python" "$pins"
apart=() # what comes from no index
if [[ $build == jetson && -z $offline ]]; then apart+=("$jetson_torch"); fi
if [[ $device == jetson && ,$extras, == *,prior-gpu,* ]]; then apart+=("$jetson_onnxruntime"); fi
# Where hashes were written (deploy/hashes.sh), nothing else is let in.
if [[ -f $checkout/deploy/requirements.lock ]]; then
  run "${pip[@]}" --require-hashes -r "$checkout/deploy/requirements.lock"
  run "${pip[@]}" --no-deps --force-reinstall "$source"
else
  run "${pip[@]}" --constraint "$pins" --upgrade "${source}${extras:+[$extras]}" "${apart[@]}" ||
    fail "pip could not install it; pip's own words are above (torch: $build)"
fi
if [[ $device == cuda || $device == jetson ]]; then compile_gsplat "$program/venv" "$(capability_of "$device")" "$pins"; fi
run install -m 0644 "$here/README.md" "$program/share/README.md"
if [[ -n $dry ]]; then exit; fi

# --- config, devices, unit ------------------------------------------------------------------------
settings=$root/etc/aquaflow
install -d -m 0750 "$settings"
if [[ -n $config ]]; then
  install -m 0640 "$config" "$settings/aquaflow.yaml"
elif [[ ! -f $settings/aquaflow.yaml ]]; then
  install -m 0640 "$here/config/bluerov2_usb.yaml" "$settings/aquaflow.yaml"
  echo "install.sh: wrote an example to $settings/aquaflow.yaml; fill in what 'aquaflow doctor devices' prints"
fi
if [[ ! -f $settings/token ]]; then
  (umask 0077; "$program/venv/bin/python" -c 'import secrets; print(secrets.token_urlsafe(32))' >"$settings/token")
fi
install -D -m 0644 "$here/99-aquaflow.rules" "$root/etc/udev/rules.d/99-aquaflow.rules"
install -D -m 0644 "$here/aquaflow.service" "$root/etc/systemd/system/aquaflow.service"
if [[ -z $root ]]; then
  chgrp -R aquaflow "$settings"
  chown aquaflow "$settings/token"
fi

# What the unit will run must work before the unit does.
"$program/venv/bin/python" -c 'import aquaflow' || fail 'the environment cannot import aquaflow'
said=$("$program/venv/bin/python" -c 'import numpy, torch; torch.from_numpy(numpy.zeros(1))' 2>&1) ||
  fail "torch does not work with what it found here (see docs/gpu.md): ${said##*$'\n'}"
if [[ -z $root ]] && command -v runuser >/dev/null; then
  runuser -u aquaflow -- "$program/venv/bin/python" -c 'import aquaflow' ||
    fail "the user aquaflow cannot run $program/venv; check the permissions of $base"
fi

if [[ -n $start ]]; then
  if command -v udevadm >/dev/null; then udevadm control --reload || true; udevadm trigger || true; fi
  systemctl daemon-reload
  systemctl enable aquaflow.service
  systemctl restart aquaflow.service
  echo 'install.sh: started; see: systemctl status aquaflow, aquaflow run status'
elif [[ -z $root ]]; then
  systemctl daemon-reload 2>/dev/null || true
fi
if [[ $device != cpu ]]; then
  echo "install.sh: the GPU was not tried yet: $program/venv/bin/aquaflow doctor"
fi
