#!/bin/sh
# Makes the Debian packages: `lumiloop`, what `make install` yields, with the scripts that tell the system, and
# `lumiloop-taps`, the libraries of the extras that a robot runs. Needs dpkg-deb, and the network.
#
#   package.sh [FOLDER]    where to put them, default out/
#   TREE                   an installation below a directory (DESTDIR), to be packed as it is; default: a new one
#   PYTHON                 as for install.sh
#
# Nothing runs from the files that dpkg unpacks: their postinst puts an environment of its own together from links to
# them, and swaps it in. An upgrade that dpkg does not finish leaves the version of before.
set -eu

SOURCE=$(cd "$(dirname "$0")/.." && pwd)
OUT=${1:-$SOURCE/out}
MADE=$(mktemp -d)
ADDED=$(mktemp -d)
trap 'rm -rf "$MADE" "$ADDED"' EXIT
PYTHON=${PYTHON:-/usr/bin/python3}

VERSION=$(sed -n 's/^version = "\(.*\)"$/\1/p' "$SOURCE/pyproject.toml")
MINOR=$("$PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
NEXT=$("$PYTHON" -c 'import sys; print("%d.%d" % (sys.version_info[0], sys.version_info[1] + 1))')
ARCH=$(dpkg --print-architecture)
TAP_UNITS=$(sed -n 's/^TAP_UNITS="\(.*\)"$/\1/p' "$SOURCE/systemd/install.sh")

VERSIONS=/opt/lumiloop-versions
LIBRARY=/usr/lib/lumiloop

if [ -n "${TREE:-}" ]; then
    cp -a "$TREE/." "$MADE"
else
    DESTDIR=$MADE PYTHON=$PYTHON "$SOURCE/systemd/install.sh" install
fi
TREE=$MADE
DESTDIR=$TREE PREFIX=/opt/lumiloop "$PYTHON" -B "$SOURCE/systemd/environment.py" taps "$ADDED$VERSIONS/.taps"
mv "$(readlink -f "$TREE/opt/lumiloop")" "$TREE$VERSIONS/.package"
rm -f "$TREE/opt/lumiloop" "$TREE$VERSIONS/.lock"
for script in environment versions; do install -D -m 644 "$SOURCE/systemd/$script.py" "$TREE$LIBRARY/$script.py"; done

chmod 755 "$TREE"
mkdir -p "$TREE/DEBIAN" "$OUT"
cat > "$TREE/DEBIAN/control" << EOF
Package: lumiloop
Version: $VERSION
Architecture: $ARCH
Maintainer: lumiloop developers <lumiloop@localhost>
Depends: python3 (>= $MINOR), python3 (<< $NEXT), systemd, udev, libc6
Installed-Size: $(du -sk "$TREE" | cut -f1)
Section: science
Priority: optional
Description: indoor robot localisation from a 2D lidar and coded ceiling lights
 One daemon that reads a HOKUYO lidar and a photodiode under coded lamps and
 publishes pose, covariance, loop flags and health over Modbus and UDP.
EOF
echo /etc/lumiloop/lumiloop.toml > "$TREE/DEBIAN/conffiles"
cat > "$TREE/DEBIAN/postinst" << 'EOF'
#!/bin/sh
set -e
if [ "$1" = configure ]; then
    python3 -B /usr/lib/lumiloop/environment.py compose
    systemd-sysusers lumiloop.conf || true
    journalctl --update-catalog > /dev/null 2>&1 || true
    if [ -d /run/systemd/system ]; then
        systemctl daemon-reload
        udevadm control --reload && udevadm trigger --subsystem-match=tty --subsystem-match=i2c-dev || true
        systemctl stop lumiloop-warmup.service || true
        systemctl try-restart lumiloop.service TAPS || true
    fi
fi
EOF
cat > "$TREE/DEBIAN/prerm" << 'EOF'
#!/bin/sh
set -e
if [ "$1" = remove ]; then
    if [ -d /run/systemd/system ]; then
        systemctl disable --now lumiloop.service lumiloop-warmup.service lumiloop-lamps.timer lumiloop-lamps.service TAPS || true
    fi
    rm -f /opt/lumiloop
    for version in /opt/lumiloop-versions/[!.]*; do rm -rf "$version"; done
    rm -f /opt/lumiloop-versions/.lock
fi
EOF
cat > "$TREE/DEBIAN/postrm" << 'EOF'
#!/bin/sh
set -e
if [ "$1" = purge ]; then
    rm -rf /var/lib/private/lumiloop /var/lib/private/lumiloop-record /var/cache/private/lumiloop /etc/lumiloop
    rm -f /var/lib/lumiloop /var/lib/lumiloop-record /var/cache/lumiloop
fi
if [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
EOF
sed -i "s/TAPS/$TAP_UNITS/" "$TREE"/DEBIAN/postinst "$TREE"/DEBIAN/prerm
chmod 755 "$TREE"/DEBIAN/postinst "$TREE"/DEBIAN/prerm "$TREE"/DEBIAN/postrm

mkdir -p "$ADDED/DEBIAN"
chmod 755 "$ADDED"
cat > "$ADDED/DEBIAN/control" << EOF
Package: lumiloop-taps
Version: $VERSION
Architecture: $ARCH
Maintainer: lumiloop developers <lumiloop@localhost>
Depends: lumiloop (= $VERSION)
Installed-Size: $(du -sk "$ADDED" | cut -f1)
Section: science
Priority: optional
Description: libraries for what listens to lumiloop: ROS 2, fleet, Foxglove, MCAP, web page
 Without them lumiloop localises all the same; commands that need one name it.
EOF
cat > "$ADDED/DEBIAN/postinst" << 'EOF'
#!/bin/sh
set -e
if [ "$1" = configure ]; then
    python3 -B /usr/lib/lumiloop/environment.py compose
    if [ -d /run/systemd/system ]; then systemctl try-restart TAPS || true; fi
fi
EOF
cat > "$ADDED/DEBIAN/postrm" << 'EOF'
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -L /opt/lumiloop ]; then python3 -B /usr/lib/lumiloop/environment.py compose || true; fi
EOF
sed -i "s/TAPS/$TAP_UNITS/" "$ADDED"/DEBIAN/postinst
chmod 755 "$ADDED"/DEBIAN/postinst "$ADDED"/DEBIAN/postrm
dpkg-deb --root-owner-group -Zgzip -z1 --build "$ADDED" "$OUT/lumiloop-taps_${VERSION}_${ARCH}.deb" > /dev/null
echo "$OUT/lumiloop-taps_${VERSION}_${ARCH}.deb"
dpkg-deb --root-owner-group -Zgzip -z1 --build "$TREE" "$OUT/lumiloop_${VERSION}_${ARCH}.deb" > /dev/null
echo "$OUT/lumiloop_${VERSION}_${ARCH}.deb"
