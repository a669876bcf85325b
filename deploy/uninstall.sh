#!/usr/bin/env bash
# Remove AquaFlow. Dives and settings stay, unless asked for.
#
#   sudo deploy/uninstall.sh [--purge]   --purge: dives, settings and the user too
set -euo pipefail

purge=''
case ${1:-} in
  '') ;;
  --purge) purge=yes ;;
  *) echo "uninstall.sh: unknown option $1" >&2; exit 1 ;;
esac
((EUID == 0)) || { echo 'uninstall.sh: run me as root' >&2; exit 1; }

if [[ -f /etc/systemd/system/aquaflow.service ]]; then
  systemctl disable --now aquaflow.service || true
  rm -f /etc/systemd/system/aquaflow.service
  rm -rf /etc/systemd/system/aquaflow.service.d
  systemctl daemon-reload
fi
rm -f /etc/udev/rules.d/99-aquaflow.rules
if command -v udevadm >/dev/null; then udevadm control --reload || true; fi
rm -rf /opt/aquaflow /var/cache/aquaflow
if [[ -n $purge ]]; then
  rm -rf /var/lib/aquaflow /etc/aquaflow
  if getent passwd aquaflow >/dev/null; then userdel aquaflow; fi
  if getent group aquaflow >/dev/null; then groupdel aquaflow; fi
elif [[ -d /var/lib/aquaflow ]]; then
  echo 'uninstall.sh: dives are still in /var/lib/aquaflow, settings in /etc/aquaflow'
fi
