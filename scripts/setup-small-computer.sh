#!/usr/bin/env bash
# Sets up a small computer on a robot: docs/small-computer.md says what for.
#
#   scripts/setup-small-computer.sh             install triform without PyTorch, and see whether the computer keeps up
#   scripts/setup-small-computer.sh lidar       name the LiDAR's serial port /dev/lidar (asks for sudo)
#   scripts/setup-small-computer.sh service     install, but not start, a systemd service that drives (asks for sudo)
#
# VENV (~/triform-venv) is where triform goes, PYTHON the Python to use. All may be run again at any time.
set -euo pipefail
sources=$(cd "$(dirname "$0")/.." && pwd)
venv=${VENV:-$HOME/triform-venv}

fail() {
    echo "setup: $1" >&2
    exit 1
}

new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

make_venv() {
    local python
    for python in ${PYTHON:-python3.11 python3.12 python3.13 python3}; do
        if new_enough "$python"; then
            "$python" -m venv "$venv" || fail "$python cannot make environments; install its venv package"
            return
        fi
    done
    [ -z "${PYTHON:-}" ] || fail "$PYTHON is no Python 3.11 or newer"
    command -v uv >/dev/null || fail "no Python 3.11 or newer is here; docs/small-computer.md says how to get one"
    uv venv --quiet --seed --python 3.11 "$venv"
}

install() {
    [ "$(getconf LONG_BIT)" = 64 ] || fail "the system is not of 64 bits"
    local glibc
    glibc=$(getconf GNU_LIBC_VERSION | cut -d ' ' -f 2)
    [ "$(printf '%s\n' 2.28 "$glibc" | sort -V | head -n 1)" = 2.28 ] ||
        fail "the system has glibc $glibc; the packages are built for 2.28 or newer (Ubuntu 20.04 has 2.31)"
    [ -x "$venv/bin/python" ] && new_enough "$venv/bin/python" || make_venv
    "$venv/bin/python" -m pip --disable-pip-version-check install --quiet --only-binary=:all: \
        --constraint "$sources/constraints.txt" --editable "$sources[robot]"
    "$venv/bin/triform" bench
}

lidar() {
    # The LiDARs come with a CP210x adapter. Members of dialout may use it.
    echo 'SUBSYSTEM=="tty", ATTRS{idVendor}=="10c4", ATTRS{idProduct}=="ea60", SYMLINK+="lidar", GROUP="dialout"' |
        sudo tee /etc/udev/rules.d/60-triform-lidar.rules >/dev/null
    sudo udevadm control --reload
    sudo udevadm trigger --subsystem-match=tty --action=change
    sudo usermod --append --groups dialout "$(id -un)"
    echo "plug the LiDAR in again, log in again, and look: ls -l /dev/lidar"
}

unit() {
    # Processor 0 serves most interrupts; a computer with one processor has no other.
    local last=$(($(nproc) - 1))
    cat <<END
[Unit]
Description=triform drives this robot
After=network-online.target
Wants=network-online.target
StartLimitIntervalSec=60
StartLimitBurst=3

[Service]
User=$(id -un)
SupplementaryGroups=dialout
Environment=OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
Environment="TRIFORM_OPTIONS=--lidar /dev/lidar"
EnvironmentFile=-/etc/default/triform-drive
CPUAffinity=$((last > 0 ? 1 : 0))-$last
ExecStart=$venv/bin/triform drive \$TRIFORM_OPTIONS
KillSignal=SIGTERM
SuccessExitStatus=143
TimeoutStopSec=5
Restart=on-failure
RestartSec=2

[Install]
WantedBy=multi-user.target
END
}

service() {
    unit | sudo tee /etc/systemd/system/triform-drive.service >/dev/null
    sudo systemctl daemon-reload
    echo "start it with: sudo systemctl start triform-drive"
}

case ${1:-install} in
    install | lidar | unit | service) "${1:-install}" ;;
    *) fail "there is no step '$1'; there are install, lidar and service" ;;
esac
