#!/usr/bin/env bash
# In the guest: install, start, a planted hang, a kill, a stop, and the way out. Each line that
# starts with RESULT is one thing that the test on the host looks at.
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
packages=$(echo "$root"/.venv/lib/python3.*/site-packages)
recording=$root/.venv/cache/kernel/recording
dives=/var/lib/aquaflow/dives

result() { echo "RESULT $*"; }
# until_true SECONDS COMMAND...: true as soon as the command is; asking costs a second of the guest.
until_true() {
  local end=$((SECONDS + $1)); shift
  until "$@"; do ((SECONDS < end)) || return 1; sleep 4; done
}
property() { systemctl show --value -p "$1" aquaflow.service; }
is() { [[ $(property "$1") == "$2" ]]; }
says() { [[ $(property StatusText) == *"$1"* ]]; }
folders() { find "$dives" -mindepth 1 -maxdepth 1 -type d | wc -l; }
checkpointed() { compgen -G "$dives/*/checkpoint/state.npz" >/dev/null; }
# What /health says of a device.
device() {
  exec 3<>/dev/tcp/127.0.0.1/8230 || return 1
  printf 'GET /health HTTP/1.0\r\nHost: 127.0.0.1:8230\r\n\r\n' >&3
  tr -d '\n' <&3 | grep -oP "\"$1\": *\{[^}]*\"state\": *\"\K[^\"]*"
  exec 3>&-
}
is_device() { [[ $(device "$1") == "$2" ]]; }

# If something goes wrong, this is what the console is read for.
journalctl -u aquaflow -o short-monotonic --no-hostname -f 2>/dev/null &

# An environment as install.sh makes it, but with the packages of this checkout: there is no network.
/usr/bin/python3 -m venv --without-pip /opt/aquaflow/venv
own=$(echo /opt/aquaflow/venv/lib/python3.*/site-packages)
printf '%s\n' "$root" "$packages" >"$own/checkout.pth"
mkdir "$own/pip" && touch "$own/pip/__init__.py" "$own/pip/__main__.py"
printf '%s\n' '#!/opt/aquaflow/venv/bin/python' 'from aquaflow.cli import main' 'main()' \
  >/opt/aquaflow/venv/bin/aquaflow
chmod +x /opt/aquaflow/venv/bin/aquaflow

# The vehicle: the kernel's own virtual camera, and an autopilot whose heart beats.
while sleep 1; do
  printf '\xfd\x09\x00\x00\x00\x01\x01\x00\x00\x00\x00\x00\x00\x00\x0c\x03\x51\x04\x03\x45\x27' \
    >/dev/udp/127.0.0.1/14600
done 2>/dev/null &
cat >/run/vehicle.yaml <<YAML
lab: true
cameras:
  front: {kind: v4l2, width: 160, height: 120, pixels: YUYV, fps: 15}
telemetry:
  devices:
    autopilot: {kind: mavlink, link: {kind: udp, mode: listen, host: 127.0.0.1, port: 14600}}
mapping:
  medium: {enabled: false}
  hold_out_every: 0
  optimiser: {steps_keyframe: 1, steps_mapping: 1, steps_common: 0, refine_steps: 1}
service:
  hang_s: 600
  checkpoint: {every_s: 2.0}
  mapping: {steps_per_view: 0, refine_seconds: 1.0}
YAML
# TCG is slow: what takes seconds on a vehicle takes a minute here.
mkdir -p /etc/systemd/system/aquaflow.service.d
printf '%s\n' '[Service]' TimeoutStartSec=600 WatchdogSec=60 TimeoutAbortSec=10 TimeoutStopSec=600 \
  >/etc/systemd/system/aquaflow.service.d/slow.conf
"$root/deploy/install.sh" --config /run/vehicle.yaml --python /usr/bin/python3 &&
  result installed "$(systemctl is-enabled aquaflow)"
until_true 600 is ActiveState active && result ready "$(property StatusText)"
result user "$(ps -o user= -p "$(property MainPID)")" dives "$(folders)"
# What udev would have done: there is none in the guest.
chown root:video /dev/video0 && chmod 0660 /dev/video0
until_true 200 says initialising && result camera "$(property StatusText)"
until_true 60 is_device autopilot connected
result devices "front $(device front) autopilot $(device autopilot)"

# A hang that nothing in the process can notice. What is started anew maps a replayed dive, of which
# a frame may take a minute; the hung one keeps the watchdog that it was started with.
replay="aquaflow run --config /etc/aquaflow/aquaflow.yaml --source $recording --speed 0.04"
printf '%s\n' '[Service]' WatchdogSec=600 ExecStart= "ExecStart=/opt/aquaflow/venv/bin/$replay" \
  >/etc/systemd/system/aquaflow.service.d/source.conf
systemctl daemon-reload
hangs() { journalctl -u aquaflow -o cat --no-pager | grep -c "Failed with result 'watchdog'"; }
hung=$(property MainPID) restarts=$(property NRestarts)
kill -STOP "$hung"
until_true 200 is NRestarts 1 && result watchdog "restarts $restarts, then hangs $(hangs)"
until_true 600 is ActiveState active && [[ $(property MainPID) != "$hung" ]] && result restarted

# A dive that is killed goes on.
until_true 600 checkpointed && result checkpoint
dive=$(dirname "$(dirname "$(compgen -G "$dives/*/checkpoint/state.npz")")")
before=$(folders)
rows=$(wc -l <"$dive/frames.csv")
kill -KILL "$(property MainPID)"
until_true 60 is NRestarts 2
until_true 600 grep -qs "resumed .*${dive##*/} with" "$dive/log.jsonl" &&
  until_true 300 is ActiveState active &&
  result resumed "new dives $(($(folders) - before))"
longer() { (($(wc -l <"$dive/frames.csv") > rows)); }
until_true 200 longer && result continued

# Stopped while it maps: report and checkpoint are there.
systemctl stop aquaflow
result stopped "$(property Result)" "$(property ActiveState)" \
  "$(cd "$dive" && ls -d metrics.json report.html checkpoint/state.npz 2>/dev/null | tr '\n' ' ')"
"$root/deploy/uninstall.sh" --purge
[[ ! -e /opt/aquaflow && ! -e /etc/systemd/system/aquaflow.service && ! -e /etc/aquaflow ]] &&
  [[ ! -e /var/lib/aquaflow && ! -e /etc/udev/rules.d/99-aquaflow.rules ]] &&
  ! getent passwd aquaflow >/dev/null && ! is LoadState loaded && result uninstalled
