#!/usr/bin/env bash
# In the guest: install, start, a planted hang, a kill, a stop, and the way out. Each line that
# starts with RESULT is one thing that the test on the host looks at.
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
packages=$(echo "$root"/.venv/lib/python3.*/site-packages)
recording=$root/.venv/cache/kernel/recording

result() { echo "RESULT $*"; }
# until SECONDS COMMAND...: true as soon as the command is; emulated clocks run slow.
until_true() { local left=$1; shift; while ((left-- > 0)); do "$@" && return 0; sleep 1; done; return 1; }
property() { systemctl show --value -p "$1" aquaflow.service; }
is() { [[ $(property "$1") == "$2" ]]; }
logged() { grep -qs "$1" "$(ls -td /var/lib/aquaflow/dives/*/ | head -n 1)log.jsonl"; }

# An environment as install.sh makes it, but with the packages of this checkout: there is no network.
/usr/bin/python3 -m venv --without-pip /opt/aquaflow/venv
own=$(echo /opt/aquaflow/venv/lib/python3.*/site-packages)
printf '%s\n' "$root" "$packages" >"$own/checkout.pth"
mkdir "$own/pip" && touch "$own/pip/__init__.py" "$own/pip/__main__.py"
printf '%s\n' '#!/opt/aquaflow/venv/bin/python' 'from aquaflow.cli import main' 'main()' \
  >/opt/aquaflow/venv/bin/aquaflow
chmod +x /opt/aquaflow/venv/bin/aquaflow

cat >/run/vehicle.yaml <<YAML
cameras:
  front: {kind: v4l2, width: 160, height: 120, pixels: YUYV, fps: 15}
telemetry:
  devices:
    autopilot: {kind: mavlink, link: {kind: udp, mode: listen, host: 127.0.0.1, port: 14600}}
mapping: {medium: {enabled: false}}
service: {checkpoint: {every_s: 2.0}, mapping: {steps_per_view: 0, refine_seconds: 1.0}}
YAML
# TCG is slow: what takes seconds on a vehicle takes a minute here.
mkdir -p /etc/systemd/system/aquaflow.service.d
printf '%s\n' '[Service]' 'TimeoutStartSec=300' 'WatchdogSec=20' 'TimeoutAbortSec=5' \
  >/etc/systemd/system/aquaflow.service.d/slow.conf
"$root/deploy/install.sh" --config /run/vehicle.yaml --python /usr/bin/python3 && result installed
until_true 200 is ActiveState active && result ready "$(property StatusText)"
# What udev would have done: there is none in the guest.
chown root:aquaflow /dev/video0 && chmod 0660 /dev/video0
until_true 120 grep -q initialising <(property StatusText) && result camera "$(property StatusText)"
result user "$(ps -o user= -p "$(property MainPID)")" dives "$(ls /var/lib/aquaflow/dives | wc -l)"

# A hang that nothing in the process can notice.
kill -STOP "$(property MainPID)"
until_true 90 is NRestarts 1 && result watchdog "$(journalctl -u aquaflow -o cat | grep -c -i 'watchdog timeout')"
until_true 200 is ActiveState active && result restarted

# A replayed dive that is killed goes on.
printf '%s\n' '[Service]' 'ExecStart=' "ExecStart=/opt/aquaflow/venv/bin/aquaflow run --config \
/etc/aquaflow/aquaflow.yaml --source $recording --speed 0.04" \
  >/etc/systemd/system/aquaflow.service.d/source.conf
systemctl stop aquaflow; rm -rf /var/lib/aquaflow/dives
systemctl daemon-reload; systemctl start aquaflow
until_true 250 compgen -G '/var/lib/aquaflow/dives/*/checkpoint/state.npz' >/dev/null && result checkpoint
kill -KILL "$(property MainPID)"
until_true 200 logged resumed && result resumed "dives $(ls /var/lib/aquaflow/dives | wc -l)"

# The guest's own disk is memory; everything else must be as it was.
touch /etc/probe 2>/dev/null && rm /etc/probe
systemctl stop aquaflow
result stopped "$(property Result)" "$(property ActiveState)"
"$root/deploy/uninstall.sh" --purge
[[ ! -e /opt/aquaflow && ! -e /etc/systemd/system/aquaflow.service && ! -e /var/lib/aquaflow ]] \
  && ! getent passwd aquaflow >/dev/null && result uninstalled
journalctl -u aquaflow -o cat --no-pager | tail -n 25
