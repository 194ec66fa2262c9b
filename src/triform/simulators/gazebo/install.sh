#!/bin/bash
# Makes Gazebo 11 and the lock-step plugin ready in an empty folder: install.sh FOLDER
#
# FOLDER gets liblockstep.so, built for the Gazebo 11 that is installed with its headers. If there is none, FOLDER/root
# gets a private Gazebo from the Debian 11 packages of the mirror that this machine already uses; nothing is installed.
set -euo pipefail
folder=$1
here=$(cd "$(dirname "$0")" && pwd)
log=$folder/log

# All output goes to the log but progress and, at the end, the reason of a failure.
exec 3>&1 4>&2 >>"$log" 2>&1

say() {
    doing=$1
    echo "$doing ..." >&3
    : >"$log"
}

fail() {
    trap - EXIT
    echo "$*" >&4
    exit 1
}

say_why() {
    [ "$1" = 0 ] && return
    local why
    why=$(grep -iE -m 1 '^E:|error|cannot|no space' "$log" || grep -v '^ *$' "$log" | tail -n 1)
    fail "it broke off while ${doing:-starting}: ${why:-status $1}"
}
trap 'say_why $?' EXIT

compile=(-O2 -std=c++17 -fPIC -shared -Wno-deprecated-declarations)

if hash gzserver pkg-config g++ && pkg-config --exists 'gazebo >= 11' 'gazebo < 12'; then
    say "building the plugin for the Gazebo $(pkg-config --modversion gazebo) of this machine"
    read -ra flags <<<"$(pkg-config --cflags gazebo)"
    g++ "${flags[@]}" "${compile[@]}" "$here/plugin/lockstep.cc" -o "$folder/liblockstep.so"
    rm "$log"
    exit
fi

if [ "$(id -u)" != 0 ]; then
    unshare --user --map-root-user true \
        || fail "a private Gazebo needs root or user namespaces; or install Gazebo 11 with its headers (libgazebo-dev)"
    trap - EXIT
    exec unshare --user --map-root-user bash "$0" "$folder" >&3 2>&4
fi
for tool in apt-get dpkg-deb tar chroot unshare; do
    command -v "$tool" >/dev/null || fail "there is no Gazebo 11 with headers here, and no $tool to fetch a private one"
done
keys=/usr/share/keyrings/debian-archive-keyring.gpg
[ -r "$keys" ] || fail "there is no $keys to check Debian's packages with; install debian-archive-keyring"
mirror=$(apt-get indextargets --format '$(REPO_URI) $(CODENAME)' | awk '$1 ~ /debian\/?$/ && $2 !~ /-/ {print $1; exit}')
[ -n "$mirror" ] || fail "this machine uses no Debian mirror; install Gazebo 11 with its headers (libgazebo-dev)"
security=$(apt-get indextargets --format '$(REPO_URI) $(CODENAME)' | awk '$2 ~ /-security$/ {print $1; exit}')
free=$(df -Pk "$folder" | awk 'NR == 2 {print int($4 / 1024)}')
[ "$free" -ge 2500 ] || fail "$folder has $free MB of free space; a private Gazebo needs 2500 MB while it is made"

# apt-get with a state of its own, as if nothing were installed.
apt=$folder/apt
# Kept if something fails, so that the next try continues.
debs=$(dirname "$folder")/downloads-$(cksum <"$0" | cut -d ' ' -f 1)
full=$folder/full
mkdir -p "$apt/lists/partial" "$apt/none" "$debs/partial" "$full"
: >"$apt/status"
cat >"$apt/sources.list" <<END
deb [signed-by=$keys] $mirror bullseye main
deb [signed-by=$keys] ${security:-${mirror%/}-security} bullseye-security main
END
cat >"$apt/apt.conf" <<END
Dir::Etc::sourcelist "$apt/sources.list";
Dir::Etc::sourceparts "$apt/none";
Dir::Etc::preferences "$apt/none/preferences";
Dir::Etc::preferencesparts "$apt/none";
Dir::State "$apt";
Dir::State::lists "$apt/lists";
Dir::State::status "$apt/status";
Dir::Cache "$apt";
Dir::Cache::archives "$debs";
Binary::apt-get::APT::Keep-Downloaded-Packages "true";
APT::Install-Recommends "false";
APT::Sandbox::User "root";
APT::Update::Error-Mode "any";
Acquire::Languages "none";
Acquire::Retries "3";
END
export APT_CONFIG=$apt/apt.conf
say "reading Debian 11's package lists"
apt-get update -qq

say "downloading Gazebo 11 and its libraries (about 320 MB)"
apt-get install -y -qq --download-only gazebo g++ bash coreutils grep libc-bin
# Headers come without what they depend on, which would be three times as much.
(cd "$debs" && apt-get download -qq lib{gazebo,sdformat,protobuf,boost1.74,tinyxml,tinyxml2,tbb}-dev uuid-dev \
    libignition-{math,common,msgs,transport,fuel-tools}-dev)

say "unpacking"
for package in "$debs"/*.deb; do
    dpkg-deb --fsys-tarfile "$package" | tar -x -C "$full" --no-same-owner --keep-directory-symlink \
        --exclude=./usr/share/{doc,man,locale,icons} --exclude='./usr/share/gazebo-11/media/*'
done
libraries=$(cd "$full/usr/lib" && echo *-linux-gnu)
printf '%s\n' {,/usr}/lib/"$libraries" /usr/lib/"$libraries"/{blas,lapack,pulseaudio} >"$full/etc/ld.so.conf"
ldconfig -r "$full"

say "building the plugin"
cp "$here/plugin/lockstep.cc" "$full/tmp/"
# shellcheck disable=SC2016
chroot "$full" /usr/bin/env -i PATH=/usr/bin:/bin LC_ALL=C \
    /bin/bash -c 'cd /tmp && g++ $(printf " -isystem%s" /usr/include/{gazebo-11,sdformat-9*,ignition/*}) "$@" \
        lockstep.cc -o liblockstep.so' bash "${compile[@]}"
cp "$full/tmp/liblockstep.so" "$folder/"

say "keeping what gzserver and the plugin load, a third of it all"
# shellcheck disable=SC2016
chroot "$full" /usr/bin/env -i PATH=/usr/bin:/bin LC_ALL=C /bin/bash -c '
    mkdir /slim
    cp -L --parents /usr/bin/gzserver /lib/*-linux-gnu/libnss_files.so.2 \
        $(ldd /usr/bin/gzserver /tmp/liblockstep.so | grep -o "/[^ :]*" | grep -v ^/tmp | sort -u) /slim'
root=$full/slim
mkdir -p "$root"/{tmp,dev,run,etc}
# Without a user gzserver aborts.
echo "root:x:0:0:root:/run:/bin/sh" >"$root/etc/passwd"
echo "127.0.0.1 localhost" >"$root/etc/hosts"
cp "$full/etc/ld.so.conf" "$root/etc/"
ldconfig -r "$root"
mv "$root" "$folder/root"
rm -rf "$apt" "$full" "$debs" "$log"
