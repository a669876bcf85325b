#!/usr/bin/env bash
# Boot what prepare.sh made, without KVM, and run a command in it; the console goes to stdout.
#
#   boot.sh FOLDER COMMAND...
#
# The guest sees this machine's / read-only, has its own /run, /dev/shm and /var/tmp, two cameras
# (vivid; the second has the multi-planar API) and a CAN bus (vcan0). Its emulated clock is uneven: test order and protocol in it, no times;
# on a busy host it is so uneven that the kernel would give up on its timer, hence no_timer_check.
set -euo pipefail

folder=$(readlink -f "$1")
shift
version=$(<"$folder/version")
guest=$folder/guest.sh
cat >"$guest" <<GUEST
export PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/run PYTHONDONTWRITEBYTECODE=1 AQUAFLOW_GUEST=1
mkdir -p /dev/shm /dev/pts
for place in /run /dev/shm; do mount -t tmpfs tmpfs \$place; done
mount -t devpts devpts /dev/pts
ip link set lo up
modprobe -d $folder/kernel vivid n_devs=2 multiplanar=1,2
modprobe -d $folder/kernel vcan
modprobe -d $folder/kernel can_raw
ip link add vcan0 type vcan
ip link set vcan0 up
cd $(printf '%q' "$PWD")
$(printf '%q ' "$@")
echo "GUEST_EXIT \$?"
echo o >/proc/sysrq-trigger
sleep 10
GUEST

exec qemu-system-x86_64 -accel tcg -cpu max -m 1536 -smp 1 -nographic -no-reboot -net none \
  -kernel "$folder/kernel/boot/vmlinuz-$version" -initrd "$folder/initramfs.gz" \
  -append "console=ttyS0 panic=-1 quiet no_timer_check guest=$guest" \
  -virtfs local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap </dev/null
