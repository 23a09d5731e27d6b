#!/bin/sh
# Installs lumiloop into a virtual environment of its own, with its units, rules and example configuration; or removes
# exactly that. An upgrade that fails or is interrupted leaves the version of before. `make install` and `make uninstall`
# call it, and the Debian package is what it yields. `install.sh files` lays down all but the environment, which stays
# as it is.
#
#   DESTDIR   put everything below this directory (a package's root); empty: into the system
#   PREFIX    the virtual environment, default /opt/lumiloop; a link into $PREFIX-versions (environment.py)
#   PYTHON    interpreter to build it with, default /usr/bin/python3 (3.11 or newer)
#   PURGE     with uninstall: 1 removes configuration, maps and caches too
set -eu

PREFIX=${PREFIX:-/opt/lumiloop}
DESTDIR=${DESTDIR:-}
PYTHON=${PYTHON:-/usr/bin/python3}
SOURCE=$(cd "$(dirname "$0")/.." && pwd)
UNITS=/usr/lib/systemd/system
SHELLS="bash zsh fish"
TAP_UNITS="lumiloop-view.service lumiloop-foxglove.service lumiloop-metrics.service lumiloop-record.service lumiloop-ros2.service lumiloop-fleet.service lumiloop-fleet-router.service"
UNIT_FILES="lumiloop.service lumiloop-warmup.service lumiloop-lamps.service lumiloop-lamps.timer $TAP_UNITS"

say() { echo "lumiloop: $*"; }

fail() {
    echo "lumiloop: $*" >&2
    exit 1
}

put() { # mode, file below the source, place
    install -D -m "$1" "$SOURCE/$2" "$INTO$3"
}

suitable() {
    "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || fail "$PYTHON is older than 3.11; name another one: PYTHON=..."
    "$PYTHON" -c 'import venv, ensurepip' 2> /dev/null || fail "the venv module is missing: apt-get install python3-venv"
}

environments() { # order; see there
    DESTDIR=$DESTDIR PREFIX=$PREFIX PYTHON=$PYTHON "$PYTHON" -B "$SOURCE/systemd/environment.py" "$@"
}

manual() { # a command of this source that prints or writes help; it needs no installed package
    PYTHONPATH=$SOURCE PYTHONDONTWRITEBYTECODE=1 "$PYTHON" -P -m daemon "$@"
}

completion() { # the place of a shell's completion script
    case "$1" in
        bash) echo usr/share/bash-completion/completions/lumiloop ;;
        zsh) echo usr/share/zsh/vendor-completions/_lumiloop ;;
        fish) echo usr/share/fish/vendor_completions.d/lumiloop.fish ;;
    esac
}

files() { # all of them are written first, and then renamed to their places
    INTO=$(mktemp -d)
    trap 'rm -rf "$INTO"' EXIT
    for unit in $UNIT_FILES; do
        install -d "$INTO$UNITS"
        sed "s|/opt/lumiloop|$PREFIX|g" "$SOURCE/systemd/$unit" > "$INTO$UNITS/$unit"
        chmod 644 "$INTO$UNITS/$unit"
    done
    put 644 systemd/60-lumiloop.rules /usr/lib/udev/rules.d/60-lumiloop.rules
    put 644 systemd/lumiloop.catalog /usr/lib/systemd/catalog/lumiloop.catalog
    put 644 systemd/lumiloop.sysusers /usr/lib/sysusers.d/lumiloop.conf
    put 644 README.md /usr/share/doc/lumiloop/README.md
    put 644 LICENSE /usr/share/doc/lumiloop/copyright
    ln -sfn copyright "$INTO/usr/share/doc/lumiloop/LICENSE" # as README.md names it
    for example in port-502 stream-group; do
        put 644 systemd/drop-ins/$example.conf /usr/share/doc/lumiloop/examples/$example.conf
    done
    recorder=$INTO/usr/share/doc/lumiloop/examples/flight-recorder.conf
    sed "s|/opt/lumiloop|$PREFIX|g" "$SOURCE/systemd/drop-ins/flight-recorder.conf" > "$recorder"
    chmod 644 "$recorder"
    (cd "$SOURCE/systemd" && find . -name '*.toml') | while read -r example; do
        put 644 "systemd/$example" "/usr/share/doc/lumiloop/examples/$example"
    done
    (cd "$SOURCE/docs" && find . -type f) | while read -r page; do
        put 644 "docs/$page" "/usr/share/doc/lumiloop/docs/$page"
    done
    for program in "$SOURCE"/tools/clients/[!_]* "$SOURCE"/tools/transmitter/[!_]*; do
        if [ -f "$program" ]; then put 644 "${program#"$SOURCE/"}" "/usr/share/doc/lumiloop/${program#"$SOURCE/"}"; fi
    done
    manual man --out "$INTO/usr/share/man/man1" > /dev/null
    for shell in $SHELLS; do
        place=$INTO/$(completion "$shell")
        install -d "$(dirname "$place")"
        manual completion "$shell" > "$place"
    done
    ln -sfn examples "$INTO/usr/share/doc/lumiloop/systemd" # as the pages name them
    for code in "$DESTDIR$PREFIX"/lib/python3*/site-packages/estimator; do # relative: it holds below DESTDIR, too
        if [ -d "$code" ]; then ln -sfn "../../../..${code#"$DESTDIR"}" "$INTO/usr/share/doc/lumiloop/estimator"; fi
    done
    mkdir -p "$INTO/usr/bin"
    ln -sfn "$PREFIX/bin/lumiloop" "$INTO/usr/bin/lumiloop"
    if [ ! -e "$DESTDIR/etc/lumiloop/lumiloop.toml" ]; then
        put 644 systemd/lumiloop.toml /etc/lumiloop/lumiloop.toml
    fi
    environments lay "$INTO"
}

tell_system() {
    if [ -n "$DESTDIR" ] || [ ! -d /run/systemd/system ]; then return; fi
    systemctl daemon-reload
    if [ "$1" = install ]; then
        systemd-sysusers lumiloop.conf
        systemctl stop lumiloop-warmup.service 2> /dev/null || true # it compiles this version with the next start
    fi
    journalctl --update-catalog || true
    udevadm control --reload && udevadm trigger --subsystem-match=tty --subsystem-match=i2c-dev || true
}

case "${1:-}" in
    install)
        suitable
        environments build
        files
        tell_system install
        if [ -n "$DESTDIR" ]; then
            say "laid down in $DESTDIR"
        else
            say "installed; edit /etc/lumiloop/lumiloop.toml, then: systemctl enable --now lumiloop"
        fi
        ;;
    files)
        files
        ;;
    uninstall)
        environments check
        if [ -z "$DESTDIR" ] && [ -d /run/systemd/system ]; then
            systemctl disable --now $UNIT_FILES 2> /dev/null || true
        fi
        environments remove
        rm -rf "$DESTDIR/usr/share/doc/lumiloop"
        for unit in $UNIT_FILES; do rm -f "$DESTDIR$UNITS/$unit"; done
        for shell in $SHELLS; do rm -f "$DESTDIR/$(completion "$shell")"; done
        rm -f "$DESTDIR"/usr/share/man/man1/lumiloop.1 "$DESTDIR"/usr/share/man/man1/lumiloop-*.1
        rm -f "$DESTDIR/usr/bin/lumiloop" \
            "$DESTDIR/usr/lib/udev/rules.d/60-lumiloop.rules" "$DESTDIR/usr/lib/systemd/catalog/lumiloop.catalog" \
            "$DESTDIR/usr/lib/sysusers.d/lumiloop.conf"
        if [ "${PURGE:-0}" = 1 ]; then
            rm -rf "$DESTDIR/etc/lumiloop" "$DESTDIR/var/cache/private/lumiloop"
            rm -rf "$DESTDIR/var/lib/private/lumiloop" "$DESTDIR/var/lib/private/lumiloop-record"
            rm -f "$DESTDIR/var/lib/lumiloop" "$DESTDIR/var/lib/lumiloop-record" "$DESTDIR/var/cache/lumiloop"
        fi
        tell_system uninstall
        if [ "${PURGE:-0}" = 1 ]; then
            say "removed, configuration, maps and recordings too"
        else
            say "removed; configuration, maps and recordings stay (PURGE=1 removes them too)"
        fi
        ;;
    *) fail "usage: $0 install | files | uninstall" ;;
esac
