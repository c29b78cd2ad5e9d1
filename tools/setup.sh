#!/bin/sh
# Debian packages for tests on real SocketCAN and of the report in a browser, and for the benchmark. Installs what is
# missing where it may (root, apt-get); otherwise names the command, and everything else works without.
set -u

have() {
    PATH="$PATH:/usr/sbin:/sbin" command -v "$1" >/dev/null 2>&1
}

af_can() {
    python3 -c 'import socket; socket.socket(socket.AF_CAN, socket.SOCK_RAW, 1)' 2>/dev/null
}

missing=""
have chromium || missing="$missing chromium"
have chromedriver || missing="$missing chromium-driver"
have ip || missing="$missing iproute2"
have cansend || missing="$missing can-utils"
have cyclictest || missing="$missing rt-tests" # the benchmark's rival in waking up
if ! af_can; then # the kernel has no SocketCAN: a user-mode-linux guest has
    have linux.uml || missing="$missing user-mode-linux"
    have insmod || missing="$missing kmod"
fi
[ -z "$missing" ] && exit 0

command="apt-get install -y --no-install-recommends$missing"
if [ "$(id -u)" = 0 ] && have apt-get; then
    echo "installing$missing"
    export DEBIAN_FRONTEND=noninteractive
    # shellcheck disable=SC2086 # a list of names
    if apt-get update -qq && apt-get install -y -qq --no-install-recommends -o DPkg::Lock::Timeout=300 $missing >/dev/null; then
        exit 0
    fi
fi
echo "tests on SocketCAN and in a browser, and the benchmark, need Debian packages that are not here. As root run: apt-get update && $command" >&2
exit 1
