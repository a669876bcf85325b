#!/usr/bin/env bash
# Install AquaFlow as a service. Safe to run again: an existing installation is updated.
#
#   sudo deploy/install.sh [options]
#     --config FILE      the vehicle's YAML (default: keep /etc/aquaflow/aquaflow.yaml, or the example)
#     --python PROGRAM   interpreter of the environment (default: python3)
#     --wheelhouse DIR   install from these wheels only, without a network
#     --extras LIST      optional parts (default: prior,telemetry,recording,viewer)
#     --torch BUILD      cpu, cuda, or system for the torch that --python has (default: auto, what
#                        fits this machine: a Jetson's own, CUDA where a GPU answers, or cpu)
#     --no-start         install, but neither enable nor start
#     --root DIR         install under DIR instead of / (for images and tests); starts nothing
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
checkout=$(dirname "$here")
config='' python=python3 wheelhouse='' extras=prior,telemetry,recording,viewer
torch=auto start=yes root=''

# shellcheck source=deploy/torch.sh
source "$here/torch.sh"
fail() { echo "install.sh: $*" >&2; exit 1; }

while (($#)); do
  case $1 in
    --config) config=${2:?--config needs a file}; shift ;;
    --python) python=${2:?--python needs a program}; shift ;;
    --wheelhouse) wheelhouse=${2:?--wheelhouse needs a folder}; shift ;;
    --extras) extras=${2?--extras needs a list}; shift ;;
    --torch) torch=${2:?--torch needs a build}; shift ;;
    --no-start) start='' ;;
    --root) root=${2:?--root needs a folder}; start=''; shift ;;
    -h | --help) sed -n '2,14s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) fail "unknown option $1; see --help" ;;
  esac
  shift
done

case $torch in auto | cpu | cuda | system) ;; *) fail "--torch is auto, cpu, cuda or system, not $torch" ;; esac
((EUID == 0)) || fail 'run me as root: sudo deploy/install.sh'
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

# --- user and groups ------------------------------------------------------------------------------
if [[ -z $root ]]; then
  getent group aquaflow >/dev/null || groupadd --system aquaflow
  getent passwd aquaflow >/dev/null || useradd --system --gid aquaflow --no-create-home \
    --home-dir /var/lib/aquaflow --shell /usr/sbin/nologin aquaflow
  for group in video render dialout plugdev; do
    if getent group "$group" >/dev/null; then usermod --append --groups "$group" aquaflow; fi
  done
fi

# --- program --------------------------------------------------------------------------------------
program=$root/opt/aquaflow
build=$(choose_torch "$python" "$torch")
system_site=''
if [[ $build == system ]]; then
  "$python" -c 'import torch' 2>/dev/null || fail "$python has no torch to use; install one, or give --torch cpu"
  system_site=yes
fi
install -d -m 0755 "$program" "$program/share"
if [[ ! -x $program/venv/bin/python ]]; then
  "$python" -m venv ${system_site:+--system-site-packages} "$program/venv"
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
install -m 0644 "$checkout/constraints.txt" "$pins"
pin_torch "$build" "$python" "$pins"
# Where hashes were written (deploy/hashes.sh), nothing else is let in.
if [[ -f $checkout/deploy/requirements.lock ]]; then
  "${pip[@]}" --require-hashes -r "$checkout/deploy/requirements.lock"
  "${pip[@]}" --no-deps --force-reinstall "$source"
else
  "${pip[@]}" --constraint "$pins" --upgrade "${source}${extras:+[$extras]}" ||
    fail "pip could not install it; pip's own words are above (torch: $build)"
fi
install -m 0644 "$here/README.md" "$program/share/README.md"

# --- config, devices, unit ------------------------------------------------------------------------
settings=$root/etc/aquaflow
install -d -m 0750 "$settings"
if [[ -n $config ]]; then
  install -m 0640 "$config" "$settings/aquaflow.yaml"
elif [[ ! -f $settings/aquaflow.yaml ]]; then
  install -m 0640 "$here/config/bluerov2_usb.yaml" "$settings/aquaflow.yaml"
  echo "install.sh: wrote an example to $settings/aquaflow.yaml; fill in what 'aquaflow devices' prints"
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
if [[ -z $root ]] && command -v runuser >/dev/null; then
  runuser -u aquaflow -- "$program/venv/bin/python" -c 'import aquaflow' ||
    fail "the user aquaflow cannot run $program/venv; check the permissions of $base"
fi

if [[ -n $start ]]; then
  if command -v udevadm >/dev/null; then udevadm control --reload || true; udevadm trigger || true; fi
  systemctl daemon-reload
  systemctl enable aquaflow.service
  systemctl restart aquaflow.service
  echo 'install.sh: started; see: systemctl status aquaflow, aquaflow status'
elif [[ -z $root ]]; then
  systemctl daemon-reload 2>/dev/null || true
fi
