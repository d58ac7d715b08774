#!/usr/bin/env bash
# Makes sure that SAPIEN finds a device to render with; with `--install` it installs the driver, as root.
# SAPIEN itself is asked, because it refuses Vulkan devices (Mesa 22.3, for one) that vulkaninfo lists.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source tools/packages.sh

can_render() {
    .venv/bin/python -c '
import sapien
summary = sapien.render.get_device_summary()
raise SystemExit(None if "Supported: 1" in summary else summary or "SAPIEN sees no device")'
}

# mirror_of RELEASE: the address from which apt takes RELEASE, or nothing.
mirror_of() {
    apt-get indextargets --format '$(RELEASE) $(REPO_URI)' 'Created-By: Packages' |
        awk -v release="$1" '$1 == release && !found {print $2; found = 1}'
}

# A software Vulkan driver. Debian 12's own is too old for SAPIEN: its backports have one that is not, on the
# mirror that this machine already uses.
install_driver() {
    local target=()
    source /etc/os-release
    apt-get update
    if [ "$ID-${VERSION_ID:-}" = debian-12 ]; then
        target=(-t bookworm-backports)
        if [ -z "$(mirror_of bookworm-backports)" ]; then
            echo "deb $(mirror_of bookworm) bookworm-backports main" >"/etc/apt/sources.list.d/bookworm-backports.list"
            apt-get update
        fi
    fi
    apt-get install -y --no-install-recommends "${target[@]}" mesa-vulkan-drivers libvulkan1 libx11-6
}

if [ "${1:-}" = --install ]; then
    install_driver
elif ! can_render 2>/dev/null; then
    as_root "a Vulkan driver that SAPIEN can render with" "$PWD/tools/ensure_renderer.sh" --install
    can_render || { echo "setup: SAPIEN still finds no rendering device: see the README, Renderer" >&2; exit 1; }
fi
