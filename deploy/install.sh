#!/bin/bash
# Installs the service that starts a follower at boot, or removes it. Prints every action; see --help.
set -eu

usage() {
  cat <<'END'
usage: deploy/install.sh [--dry-run] [--undo] [--user USER] [--name NAME] [--workspace FOLDER] [--root FOLDER]

Installs flock_follower@.service, its programs, the udev rule of the flight controller, a kernel setting, a setting of logins, and
/etc/flock_follower/NAME.env, which belongs to you: it is never overwritten. Starts and enables nothing. Run it again after an update.

  --dry-run           print the actions, change nothing
  --undo              stop the service and remove the files; keeps logs, recordings, and settings that you changed
  --user USER         the user of camera and odometry, who also runs the follower (default: the caller of sudo)
  --name NAME         of the vehicle, or of its configuration (default: follower)
  --workspace FOLDER  the colcon workspace (default: the one that contains this file)
  --root FOLDER       install below FOLDER instead of /, without systemd and udev (default: $DESTDIR)
END
}

here=$(cd "$(dirname "$0")" && pwd)
root=${DESTDIR:-} user=${SUDO_USER:-} name=follower workspace='' dry='' undo=''
fail() { echo "error: $*" >&2; exit 2; }
while [ $# -gt 0 ]; do
  case $1 in
    --dry-run) dry=yes ;;
    --undo) undo=yes ;;
    --user | --name | --workspace | --root)
      [ $# -gt 1 ] || fail "$1 needs a value"
      printf -v "${1#--}" %s "$2"
      shift ;;
    -h | --help) usage; exit ;;
    *) usage >&2; fail "unknown argument: $1" ;;
  esac
  shift
done
root=${root%/}
[[ $name =~ ^[A-Za-z0-9_]+$ ]] || fail "--name $name: letters, digits and _ only"
[[ $user =~ ^[A-Za-z0-9_.-]*$ ]] || fail "--user $user: not a user name"
[ -n "$dry$root" ] || [ "$(id -u)" = 0 ] || fail 'only root may write there: sudo deploy/install.sh'

unit=$root/etc/systemd/system/flock_follower@.service
rule=$root/etc/udev/rules.d/61-flight-controller.rules
kernel=$root/etc/sysctl.d/05-flock_follower.conf
logins=$root/etc/systemd/logind.conf.d/05-flock_follower.conf
programs=$root/usr/local/lib/flock_follower
settings=$root/etc/flock_follower

# Prints an action, and runs it unless this is a dry run.
act() {
  echo "  $*"
  [ -n "$dry" ] || "$@"
}

# The same for an action that may fail: in a container neither systemd nor udev runs.
try() { act "$@" || echo "  failed, ignored: $*"; }

# put MODE CONTENT FILE: writes a file of the package if it is missing or differs.
put() {
  if [ -f "$3" ] && [ "$(cat "$3")" = "$2" ]; then
    echo "  up to date: $3"
    return
  fi
  # An earlier version, or one changed by hand: keep a copy.
  if [ -f "$3" ]; then act cp --preserve "$3" "$3.old"; fi
  echo "  write $3"
  [ -n "$dry" ] || printf '%s\n' "$2" | install -D -m "$1" /dev/stdin "$3"
}

# Makes systemd, logind and udev read the new files; not below another root.
reload() {
  [ -z "$root" ] || return 0
  try systemctl daemon-reload
  # It reads its settings again, and ends no login.
  try systemctl kill --signal=HUP systemd-logind
  try udevadm control --reload
  try udevadm trigger --subsystem-match=tty --subsystem-match=usb
}

install_all() {
  [ -n "$user" ] || fail 'no user: --user USER names the user of camera and odometry'
  [ -n "$root" ] || id "$user" >/dev/null || fail "--user $user: no such user on this computer"
  if [ -z "$workspace" ]; then
    workspace=$here
    while [ "$workspace" != / ] && [ ! -f "$workspace/install/setup.bash" ]; do workspace=$(dirname "$workspace"); done
    [ "$workspace" != / ] || fail "no install/setup.bash above $here: build the workspace with colcon, or give it: --workspace FOLDER"
  fi
  [[ $workspace = /* ]] || fail "--workspace $workspace: must begin with /"
  echo "installing for the user $user, workspace $workspace:"
  put 644 "$(sed "s/^User=.*/User=$user/" "$here/flock_follower@.service")" "$unit"
  put 755 "$(cat "$here/start")" "$programs/start"
  put 755 "$(cat "$here/prefer_realtime")" "$programs/prefer_realtime"
  put 644 "$(cat "$here/61-flight-controller.rules")" "$rule"
  put 644 "$(cat "$here/05-flock_follower.conf")" "$kernel"
  put 644 "$(cat "$here/logind.conf")" "$logins"
  # Its number is low, so a larger value set by another file (Cyclone DDS) wins.
  if [ -z "$root" ] && [ "$(sysctl -n net.core.rmem_max)" -lt 4194304 ]; then try sysctl --quiet --load "$kernel"; fi
  if [ -e "$settings/$name.env" ]; then
    echo "  yours, unchanged: $settings/$name.env"
  else
    local example
    example=$(cat "$here/example.env")
    example=${example/WORKSPACE_FOLDER/"$workspace"}
    # A copy, by which --undo detects changes.
    put 644 "$example" "$programs/$name.env"
    put 644 "$example" "$settings/$name.env"
  fi
  reload
  echo "next: put the topics of your camera and odometry into $settings/$name.env, then"
  echo "  sudo systemctl enable --now flock_follower@$name"
  echo "  journalctl -fu flock_follower@$name"
}

undo_all() {
  echo 'removing:'
  for file in "$settings"/*.env; do
    [ -e "$file" ] || continue
    [ -n "$root" ] || try systemctl disable --now "flock_follower@$(basename "$file" .env).service"
    if cmp -s "$file" "$programs/$(basename "$file")"; then
      act rm "$file"
    else
      echo "  yours, unchanged: $file"
    fi
  done
  for file in "$unit" "$rule" "$kernel" "$logins" "$programs"/start "$programs"/prefer_realtime "$programs"/*.env; do
    if [ -e "$file" ]; then act rm "$file"; fi
  done
  for folder in "$programs" "$settings"; do
    if [ -d "$folder" ]; then act rmdir --ignore-fail-on-non-empty "$folder"; fi
  done
  reload
  for folder in "$root/var/log/flock_follower" "$root/var/lib/flock_follower"; do
    if [ -d "$folder" ]; then echo "  yours, unchanged: $folder"; fi
  done
}

if [ -n "$undo" ]; then undo_all; else install_all; fi
