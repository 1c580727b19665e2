#!/usr/bin/env bash
# Runs a command where a real SocketCAN vcan0 exists; see usage() below.
#
# A kernel that has a vcan0 already runs the command directly. Any other boots Debian's user-mode-linux, a kernel that
# is an ordinary process: no KVM, no container, no root. Its packages are unpacked into a cache, never installed. The
# guest sees the host's files read-only, with whatever it writes kept in its memory; guest_init.sh is its first process.
set -euo pipefail

here=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")" && pwd)
readonly here
readonly me=run_in_guest
readonly CANNOT=77 DIED=125 TIMED_OUT=124
readonly CACHE_FORMAT=1

usage() {
    cat <<USAGE
usage: run_in_guest.sh [options] -- CMD [ARG...]

Runs CMD with a SocketCAN interface vcan0 that is up: directly where this kernel has one, else in a small
user-mode-linux guest. CMD gets the same files, directory, environment and PATH as here (files read-only, changes are
forgotten), TDHIL_VCAN=vcan0 and TDHIL_REQUIRE_VCAN=1. In the guest it is root, on one CPU, with no network, and its
stdin is empty.

  -t SECONDS  time CMD may take (default 600)
  -n COUNT    that many interfaces: vcan0, vcan1, … (default 1)
  -o DIR      a directory of the host that CMD may write to, at the same path (made if missing; repeatable)
  -m MB       memory of the guest (default 1024)
  -g          the guest, even if this kernel has a vcan0
  -q          say nothing about the guest
  -h          this text

exit: CMD's own status (128+N if signal N killed it), or
   2  wrong usage
  77  no vcan0 can be had on this machine; one line on stderr says why
 124  CMD took too long
 125  the guest died under CMD
 130, 143, 129  interrupted by SIGINT, SIGTERM, SIGHUP
The downloads are kept in \${XDG_CACHE_HOME:-\$HOME/.cache}/tdhil-vcan; delete it to fetch them anew.
USAGE
}

say() { ((quiet)) || printf '%s: %s\n' "$me" "$*" >&2; }
wrong() {
    printf '%s: %s (-h for help)\n' "$me" "$*" >&2
    exit 2
}
cannot() {
    printf '%s: no vcan0: %s\n' "$me" "$*" >&2
    exit "$CANNOT"
}

# ---------------------------------------------------------------------------------------------------------------------
# The host's own interfaces

host_has_links() { # COUNT: are vcan0 … vcan(COUNT-1) there, CAN (ARPHRD_CAN = 280) and up (IFF_UP = 1)?
    local i link
    for ((i = 0; i < $1; i++)); do
        link=/sys/class/net/vcan$i
        [[ -r $link/type && $(<"$link/type") == 280 ]] || return 1
        (($(<"$link/flags") & 1)) || return 1
    done
}

# ---------------------------------------------------------------------------------------------------------------------
# The cache: $cache/guest holds linux.uml, root/ (what the guest boots from), bin/ (can-utils), sizes (what is complete)

need() { # TOOL PACKAGE: missing tools are named with the command that brings them
    command -v "$1" >/dev/null || cannot "$1 is missing; on Debian: apt-get install $2"
}

cache_is_whole() {
    [[ -f $cache/guest/sizes ]] && list_sizes "$cache/guest" | cmp -s - "$cache/guest/sizes"
}

list_sizes() { (cd -- "$1" && find . -type f ! -name sizes -printf '%s %P\n' | LC_ALL=C sort); }

unpack() { # PACKAGE DIR: from what is installed here, else from the Debian archive
    local package=$1 into=$2 file
    if dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed'; then
        dpkg-query -L "$package" | while IFS= read -r file; do
            [[ ! -f $file || $file == /usr/share/* ]] || cp --parents -- "$file" "$into"
        done
        return
    fi
    rm -f -- "$build"/*.deb
    if ! download "$package"; then
        # Lists missing (containers) or too old. They are fetched into the build directory: no root, and apt's own stay.
        [[ -d $build/lists ]] && return 1
        mkdir -p "$build/lists/partial" "$build/archives/partial"
        apt_options+=(-o "Dir::State::Lists=$build/lists" -o "Dir::Cache=$build" -o "Dir::Cache::Archives=$build/archives")
        apt-get "${apt_options[@]}" update >>"$build/log" 2>&1 || true
        download "$package" || return 1
    fi
    dpkg-deb -x "$build"/*.deb "$into"
}

download() { (cd -- "$build" && apt-get "${apt_options[@]}" download "$1" >>"$build/log" 2>&1); }

why_not() { # the last complaint in the log
    sed -n 's/^E: //p' "$build/log" | tail -n 1
}

fill_cache() {
    local tree=$build/tree made=$build/guest modules kernel busybox file
    # root needs no other user to download; without this apt warns about its sandbox
    apt_options=(-q -o APT::Sandbox::User=root)
    mkdir -p "$tree" "$made/root"
    : >"$build/log"
    for package in user-mode-linux busybox-static; do
        say "fetching Debian's $package (once)"
        unpack "$package" "$tree" || cannot "Debian's package $package can't be had ($(why_not)); by hand: apt-get install $package"
    done
    say "fetching Debian's can-utils (once)"
    unpack can-utils "$tree" || say "no can-utils ($(why_not)): candump, cansend and cangw will be missing in the guest"

    modules=$(find "$tree/usr/lib/uml/modules" -mindepth 1 -maxdepth 1 -type d | head -n 1)
    kernel=${modules##*/}
    busybox=$(find "$tree/bin" "$tree/usr/bin" -name busybox -type f 2>/dev/null | head -n 1)
    [[ -n $kernel && -n $busybox && -x $tree/usr/bin/linux.uml ]] || cannot "Debian's packages do not hold the files expected"

    cp -- "$tree/usr/bin/linux.uml" "$made/linux.uml"
    mkdir -p "$made/root/"{bin,dev,host,new,proc,sys,upper} "$made/bin"
    cp -- "$busybox" "$made/root/bin/busybox"
    # Of the modules only what is wanted and what that depends on (modules.dep: "module: dependency dependency …").
    mkdir -p "$made/root/lib/modules/$kernel"
    cp -- "$modules/modules.dep" "$made/root/lib/modules/$kernel/"
    grep -E '/(overlay|can-raw|can-bcm|can-gw|vcan)\.ko' "$modules/modules.dep" | tr -d : | tr ' ' '\n' | sort -u |
        while IFS= read -r file; do
            mkdir -p "$made/root/lib/modules/$kernel/${file%/*}"
            cp -- "$modules/$file" "$made/root/lib/modules/$kernel/$file"
        done
    find "$tree/usr/bin" -type f ! -name linux.uml ! -name busybox -exec cp -t "$made/bin" -- {} +
    list_sizes "$made" >"$made/sizes"
}

prepare_cache() {
    local tool
    [[ $(uname -m) == x86_64 ]] || cannot "user-mode-linux exists for amd64 only, this is $(uname -m)"
    [[ -n ${XDG_CACHE_HOME:-}${HOME:-} ]] || cannot "neither XDG_CACHE_HOME nor HOME is set, so there is no place for the cache"
    cache=${XDG_CACHE_HOME:-$HOME/.cache}/tdhil-vcan/$CACHE_FORMAT
    mkdir -p -- "$cache" 2>/dev/null || cannot "the cache $cache can't be written"
    for tool in flock setsid setpriv; do need "$tool" util-linux; done
    need timeout coreutils
    need cmp diffutils
    # One run at a time looks and builds; the others wait for it and then find the cache whole.
    exec {lock}>"$cache/lock"
    flock "$lock"
    if ! cache_is_whole; then
        need apt-get apt
        need dpkg-deb dpkg
        rm -rf -- "$cache/guest" "$cache"/build.*
        build=$(mktemp -d -- "$cache/build.XXXXXX")
        fill_cache
        mv -T -- "$build/guest" "$cache/guest"
        rm -rf -- "$build"
        build=
    fi
    exec {lock}>&-
}

# ---------------------------------------------------------------------------------------------------------------------
# The guest

memory_directory() { # where the guest's memory can lie: a tmpfs that allows execution and has the room
    local dir why="/dev/shm is missing"
    for dir in "${TMPDIR:-}" /dev/shm "${XDG_RUNTIME_DIR:-}" /tmp; do
        [[ -n $dir && -d $dir && -w $dir ]] || continue
        if [[ $(stat -f -c %T -- "$dir") != tmpfs ]]; then
            [[ $dir == /tmp ]] || continue
            # The kernel falls back to /tmp by itself if it finds no tmpfs in /dev/shm: slower, but it works.
            [[ $(stat -f -c %T /dev/shm 2>/dev/null) != tmpfs ]] || continue
        fi
        if findmnt -n -o OPTIONS -T "$dir" | grep -qw noexec; then
            why="$dir is mounted noexec (in a container: --tmpfs /dev/shm:exec)"
        elif (($(df --output=avail -m -- "$dir" | tail -n 1) < memory)); then
            why="$dir has less than $memory MB free (in a container: --shm-size=2g; or a smaller -m)"
        else
            printf '%s\n' "$dir"
            return
        fi
    done
    printf '%s\n' "$why"
    return 1
}

write_command() { # the script that the guest's bash runs: the caller's environment and directory, then CMD
    export -p
    printf 'export PATH=%q TDHIL_VCAN=vcan0 TDHIL_REQUIRE_VCAN=1\n' "$PATH:$cache/guest/bin"
    printf 'umask %s\n' "$(umask)"
    printf 'cd -- %q || exit 126\n' "$PWD"
    printf 'limit=%q command=(%s)\n' "$limit" "$(printf '%q ' "$@")"
    cat <<'RUN'
out_tty=${out_tty-0} err_tty=${err_tty-0}
[[ -z ${TMPDIR-} ]] || mkdir -p -- "$TMPDIR"
# A terminal only where the caller has one: programs choose colours and buffering by it.
relays=()
if ((out_tty)); then exec 5>&8; else exec 5> >(exec cat >&8); relays+=($!); fi
if ((err_tty)); then exec 6>&9; else exec 6> >(exec cat >&9); relays+=($!); fi
export -n out_tty err_tty
SECONDS=0
timeout -k 5 "$limit" "${command[@]}" >&5 2>&6 5>&- 6>&- 7<&- 8>&- 9>&-
status=$?
# What has to be killed after the time-out ends with 137: that too is a time-out.
if ((status == 137 && SECONDS >= ${limit%.*})); then status=124; fi
exec 5>&- 6>&-
# Let the last words out, but don't wait for ever for a daemon that CMD left behind with our pipe.
for ((i = 0; i < 50; i++)); do
    kill -0 "${relays[@]}" 2>/dev/null || break
    sleep 0.1
done
exit "$status"
RUN
}

stop_guest() {
    local i
    [[ -n $guest ]] || return 0
    # Asked first: on SIGTERM the kernel takes its processes with it. Killed outright they could be left behind.
    kill -TERM "$guest" 2>/dev/null || true
    for ((i = 0; i < 30; i++)); do
        kill -0 -- "-$guest" 2>/dev/null || break
        sleep 0.1
    done
    kill -KILL -- "-$guest" 2>/dev/null || true
    wait "$guest" 2>/dev/null || true
    guest=
}

clean_up() {
    trap '' INT TERM HUP
    stop_guest
    [[ -z $work ]] || rm -rf -- "$work"
    [[ -z $build ]] || rm -rf -- "$build"
}

run_in_guest() {
    local memory_dir rows columns out_tty=0 err_tty=0 out err console hold relays=() state status=0 relay dir

    memory_dir=$(memory_directory) || cannot "no memory for the guest: $memory_dir"
    sweep
    work=$(mktemp -d -- "${TMPDIR:-/tmp}/tdhil-vcan.XXXXXX") || cannot "no temporary directory"
    exec {hold}<"$work"
    flock "$hold"
    # The kernel's command line is split at spaces.
    [[ $work != *[[:space:]]* ]] || cannot "TMPDIR has a space in its path: $work"
    case $PWD/ in /dev/* | /proc/* | /sys/*) cannot "the current directory $PWD does not exist in the guest" ;; esac

    cp -r -- "$cache/guest/root" "$work/root"
    cp -- "$here/guest_init.sh" "$work/root/init"
    chmod +x "$work/root/init"
    : >"$work/root/writable"
    for dir in "${writable[@]}"; do printf '%s\n' "$dir" >>"$work/root/writable"; done
    write_command "$@" >"$work/root/command"
    read -r rows columns < <(stty size 2>/dev/null </dev/tty || echo 0 0)
    [[ ! -t 1 ]] || out_tty=1
    [[ ! -t 2 ]] || err_tty=1
    printf '%s\n' "links=$links rows=$rows columns=$columns out_tty=$out_tty err_tty=$err_tty" >"$work/root/settings"

    # Through pipes of our own: the guest sets its descriptors non-blocking, which would stick to the caller's.
    exec {out}> >(trap '' INT; exec cat)
    relays+=($!)
    exec {err}> >(trap '' INT; exec cat >&2)
    relays+=($!)
    exec {console}> >(trap '' INT; exec cat >"$work/console")
    relays+=($!)

    # A session of its own, so that Ctrl-C reaches us alone and the whole guest is one process group to stop; and
    # should we be killed outright, the guest is told to end. The outer time-out is for a guest that hangs.
    TMPDIR=$memory_dir setsid setpriv --pdeathsig TERM timeout --foreground -k 5 "$((${limit%.*} + 60))" \
        "$cache/guest/linux.uml" "mem=${memory}M" root=/dev/root rootfstype=hostfs "rootflags=$work/root" rw init=/init \
        "uml_dir=$work/uml/" con=null con0=null,fd:3 con1=null,fd:4 con2=null,fd:5 ssl=null console=tty0 quiet panic=-1 noreboot \
        </dev/null 3>&"$console" 4>&"$out" 5>&"$err" {out}>&- {err}>&- {console}>&- >&3 2>&3 &
    guest=$!
    give_weight
    exec {out}>&- {err}>&- {console}>&-
    wait "$guest" 2>/dev/null || status=$?
    # Nothing of it may be left, also after a death that was not orderly.
    if ((status)); then stop_guest; fi
    guest=
    for relay in "${relays[@]}"; do wait "$relay" || true; done

    state=$(cat "$work/root/state" 2>/dev/null || true)
    if [[ $state == *"exit "* ]]; then
        return "${state##*exit }"
    fi
    if [[ -z $state ]]; then
        cannot "the guest did not boot: $(reason)"
    fi
    if ((status == 124 || status == 137)); then
        printf '%s: the guest hung and was ended after %s s\n' "$me" "$((${limit%.*} + 60))" >&2
        return "$TIMED_OUT"
    fi
    printf '%s: the guest died under the command: %s\n' "$me" "$(reason)" >&2
    return "$DIED"
}

give_weight() { # to the guest's scheduling group, so that whatever else computes on this machine doesn't stop its clock
    # It waits most of the time and takes little. Only root may ask, and only a kernel with autogroups knows it: for
    # anybody else the guest has its ordinary share.
    local pid
    for _ in {1..30}; do
        sleep 0.1
        pid=$(cat "$work"/uml/*/pid 2>/dev/null) || continue
        echo -19 2>/dev/null >"/proc/$pid/autogroup" || true
        return 0
    done
}

sweep() { # scratch directories of runs that were killed outright: ours, not fresh, and no longer held
    local old hold
    find "${TMPDIR:-/tmp}" -mindepth 1 -maxdepth 1 -type d -name 'tdhil-vcan.*' -user "$(id -u)" -mmin +1 2>/dev/null |
        while IFS= read -r old; do
            exec {hold}<"$old" || continue
            if flock -n "$hold"; then rm -rf -- "$old"; fi
            exec {hold}>&-
        done
}

reason() { # the line of the guest's console that says most: our own complaint, a panic's first line, else the last one
    local lines
    lines=$(tr -d '\r' <"$work/console" | grep -av -e ' ubd ' -e '^ *$' || true)
    grep -a '^guest: ' <<<"$lines" | head -n 1 | grep . ||
        grep -a 'Kernel panic' <<<"$lines" | head -n 1 | grep . ||
        tail -n 1 <<<"${lines:-it said nothing}"
}

# ---------------------------------------------------------------------------------------------------------------------

limit=600 links=1 memory=1024 quiet=0 force=0 writable=()
cache='' build='' work='' guest=''
while getopts ":t:n:o:m:gqh" option; do
    case $option in
    t) limit=$OPTARG ;;
    n) links=$OPTARG ;;
    o) writable+=("$(realpath -m -- "$OPTARG")") ;;
    m) memory=$OPTARG ;;
    g) force=1 ;;
    q) quiet=1 ;;
    h)
        usage
        exit 0
        ;;
    :) wrong "-$OPTARG needs a value" ;;
    *) wrong "unknown option -$OPTARG" ;;
    esac
done
shift $((OPTIND - 1))
[[ $limit =~ ^[0-9]+(\.[0-9]+)?$ && $limit != 0 ]] || wrong "-t: not a time: $limit"
[[ $links =~ ^[1-9][0-9]?$ ]] || wrong "-n: not a number of interfaces: $links"
[[ $memory =~ ^[1-9][0-9]+$ ]] || wrong "-m: not a number of megabytes: $memory"
(($#)) || wrong "no command"
for directory in "${writable[@]}"; do
    mkdir -p -- "$directory" || wrong "-o: $directory can't be made"
done

if ((!force)) && host_has_links "$links"; then
    export TDHIL_VCAN=vcan0 TDHIL_REQUIRE_VCAN=1
    exec timeout --foreground -k 5 "$limit" "$@"
fi

trap clean_up EXIT
trap 'exit 130' INT
trap 'exit 143' TERM
trap 'exit 129' HUP
prepare_cache
say "this kernel has no vcan0 that is up: running in a user-mode-linux guest"
run_in_guest "$@"
