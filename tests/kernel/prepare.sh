#!/usr/bin/env bash
# Fetch the stock Debian kernel and make an initramfs that mounts this machine's / over 9p.
#
#   prepare.sh FOLDER
#
# Needs: apt-get install --no-install-recommends qemu-system-x86 busybox-static kmod v4l-utils can-utils
# Does nothing where FOLDER is ready. Where something is missing it says so and makes nothing; the
# tests are then skipped with the same reason.
set -euo pipefail

folder=$1
[[ -f $folder/version ]] && exit 0

for tool in qemu-system-x86_64 busybox modprobe depmod dpkg-deb apt-get; do
  if ! command -v "$tool" >/dev/null; then
    echo "test-kernel: $tool is missing; see the head of tests/kernel/prepare.sh"
    exit 0
  fi
done

mkdir -p "$folder"
folder=$(readlink -f "$folder")
cd "$folder"

# linux-image-amd64 itself is empty; it depends on the image of the day.
if ! compgen -G 'linux-image-*.deb' >/dev/null; then
  package=$(apt-cache depends linux-image-amd64 2>/dev/null | awk '/Depends/ {print $2; exit}')
  if [[ -z $package ]] || ! apt-get download -qq "$package"; then
    echo "test-kernel: no kernel image can be fetched; put linux-image-*.deb into $folder"
    exit 0
  fi
fi
dpkg-deb -x linux-image-*.deb kernel
version=$(basename kernel/lib/modules/*)
depmod -b kernel "$version"

# Only what it takes to mount /: everything else is loaded from there.
mkdir -p initramfs/{bin,modules,proc,sys,dev,newroot}
cp "$(command -v busybox)" initramfs/bin/
for module in 9p 9pnet_virtio virtio_pci; do
  modprobe -d "$folder/kernel" -S "$version" --show-depends "$module"
done | awk '$1 == "insmod" && !seen[$2]++ {print $2}' | while read -r file; do
  cp "$file" initramfs/modules/
  basename "$file" >>initramfs/modules/order
done
cat >initramfs/init <<'INIT'
#!/bin/busybox sh
B=/bin/busybox
$B mount -t proc proc /proc
$B mount -t sysfs sysfs /sys
$B mount -t devtmpfs devtmpfs /dev
while read -r module; do $B insmod "/modules/$module"; done </modules/order
$B mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=524288 root /newroot
for d in proc sys dev; do $B mount --move /$d /newroot/$d; done
guest=$($B tr ' ' '\n' </newroot/proc/cmdline | $B sed -n 's/^guest=//p')
exec $B chroot /newroot /bin/bash "$guest"
INIT
chmod +x initramfs/init
(cd initramfs && find . | busybox cpio -o -H newc 2>/dev/null | gzip -1 >../initramfs.gz)
echo "$version" >version
