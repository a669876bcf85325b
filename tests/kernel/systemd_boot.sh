#!/usr/bin/env bash
# Boot what prepare.sh made with real systemd as PID 1, and run a script in it as a service; the
# console goes to stdout, the last line is GUEST_EXIT and the script's exit status.
#
#   systemd_boot.sh FOLDER SCRIPT
#
# The guest sees this machine's / under an overlay in memory: what it writes is gone with it.
set -euo pipefail

folder=$(readlink -f "$1")
script=$(readlink -f "$2")
version=$(<"$folder/version")
work=$(mktemp -d -p "$folder")
trap 'rm -rf "$work"' EXIT
cp -r "$folder/initramfs" "$work/initramfs"
cat >"$work/initramfs/init" <<INIT
#!/bin/busybox sh
B=/bin/busybox
\$B mount -t proc proc /proc
\$B mount -t sysfs sysfs /sys
\$B mount -t devtmpfs devtmpfs /dev
while read -r module; do \$B insmod "/modules/\$module"; done </modules/order
\$B mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=524288 root /newroot
for module in overlay vivid; do
  \$B mount --bind /dev /newroot/dev; \$B mount --bind /proc /newroot/proc; \$B mount --bind /sys /newroot/sys
  \$B chroot /newroot /sbin/modprobe -d $folder/kernel \$module
  \$B umount /newroot/sys; \$B umount /newroot/proc; \$B umount /newroot/dev
done
\$B mkdir -p /memory /merged
# More than there is memory: on a disk that looks full the service would keep no checkpoint.
\$B mount -t tmpfs -o size=8g memory /memory
\$B mkdir /memory/upper /memory/work
\$B mount -t overlay -o lowerdir=/newroot,upperdir=/memory/upper,workdir=/memory/work root /merged
# This machine may be a container; the guest is none, and systemd would hold it for one.
\$B rm -f /merged/.dockerenv
units=/merged/etc/systemd/system
\$B rm -rf \$units/*.wants
# What would walk this machine's whole disk over 9p, or wait for devices that are not there.
for unit in tmpfiles-setup tmpfiles-setup-dev udev-trigger random-seed journal-flush sysusers \
  update-utmp machine-id-commit remount-fs fsck-root hwdb-update udevd modules-load sysctl; do
  \$B ln -sf /dev/null \$units/systemd-\$unit.service
done
for unit in dev-hugepages.mount dev-mqueue.mount sys-kernel-debug.mount sys-kernel-tracing.mount \
  sys-kernel-config.mount sys-fs-fuse-connections.mount modprobe@.service; do
  \$B ln -sf /dev/null \$units/\$unit
done
for place in /merged/tmp /merged/var/tmp; do \$B mount -t tmpfs -o mode=1777 place \$place; done
\$B printf '%s\n' '[Unit]' 'DefaultDependencies=no' 'Wants=systemd-journald.service' \
  'After=systemd-journald.service' '[Service]' 'Type=oneshot' 'StandardOutput=tty' 'StandardError=tty' \
  'TTYPath=/dev/ttyS0' 'TimeoutStartSec=infinity' \
  'ExecStart=/bin/bash $work/guest.sh' 'ExecStopPost=/bin/sh -c "echo o >/proc/sysrq-trigger"' \
  >\$units/guest.service
for d in proc sys dev; do \$B mount --move /\$d /merged/\$d; done
exec \$B switch_root /merged /lib/systemd/systemd --unit=guest.service
INIT
cat >"$work/guest.sh" <<GUEST
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
ip link set lo up
bash $(printf '%q' "$script")
echo "GUEST_EXIT \$?"
GUEST
(cd "$work/initramfs" && find . | busybox cpio -o -H newc 2>/dev/null | gzip -1 >"$work/initramfs.gz")

timeout "${TIMEOUT_S:-560}" qemu-system-x86_64 -accel tcg -cpu max -m 2560 -smp 1 -nographic \
  -no-reboot -net none -kernel "$folder/kernel/boot/vmlinuz-$version" -initrd "$work/initramfs.gz" \
  -append "console=ttyS0 panic=-1 quiet no_timer_check mitigations=off no5lvl systemd.show_status=false systemd.log_level=warning systemd.journald.forward_to_console=0" \
  -virtfs "local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap" </dev/null
