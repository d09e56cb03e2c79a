#!/bin/bash
# Install what starts a follower at boot, or take it away again. Every action is printed; --help tells the rest.
set -eu

usage() {
  cat <<'END'
usage: deploy/install.sh [--dry-run] [--undo] [--user USER] [--name NAME] [--workspace FOLDER] [--root FOLDER]

Installs flock_follower@.service, what it runs, the udev rule of the flight controller, a setting of the kernel, and
/etc/flock_follower/NAME.env, which is yours from then on: it is never overwritten. Starts and enables nothing. Run it again after an update.

  --dry-run           print what would be done, and do nothing
  --undo              stop and remove what was installed; keeps logs, recordings, and settings that you changed
  --user USER         who runs camera and odometry, and so the follower (default: who called sudo)
  --name NAME         of the vehicle, or of its configuration (default: follower)
  --workspace FOLDER  the colcon workspace (default: the one that this file is in)
  --root FOLDER       install below FOLDER instead of /, and tell neither systemd nor udev (default: $DESTDIR)
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
[[ $user =~ ^[A-Za-z0-9_.-]*$ ]] || fail "--user $user: is no name of a user"
[ -n "$dry$root" ] || [ "$(id -u)" = 0 ] || fail 'only root may write there: sudo deploy/install.sh'

unit=$root/etc/systemd/system/flock_follower@.service
rule=$root/etc/udev/rules.d/61-flight-controller.rules
kernel=$root/etc/sysctl.d/05-flock_follower.conf
programs=$root/usr/local/lib/flock_follower
settings=$root/etc/flock_follower

# Print an action, and do it unless this is a dry run.
act() {
  echo "  $*"
  [ -n "$dry" ] || "$@"
}

# The same for what need not succeed: in a container neither systemd nor udev runs.
tell() { act "$@" || echo "  failed, and left at that: $*"; }

# put MODE CONTENT FILE: write a file of ours where it is not there, or another version of it is.
put() {
  if [ -f "$3" ] && [ "$(cat "$3")" = "$2" ]; then
    echo "  up to date: $3"
    return
  fi
  # Of an earlier version of ours, or changed by hand: nobody's work is lost.
  if [ -f "$3" ]; then act cp --preserve "$3" "$3.old"; fi
  echo "  write $3"
  [ -n "$dry" ] || printf '%s\n' "$2" | install -D -m "$1" /dev/stdin "$3"
}

# Have systemd and udev read what has changed; not below another root.
reload() {
  [ -z "$root" ] || return 0
  tell systemctl daemon-reload
  tell udevadm control --reload
  tell udevadm trigger --subsystem-match=tty --subsystem-match=usb
}

install_all() {
  [ -n "$user" ] || fail 'who runs camera and odometry? name them: --user USER'
  [ -n "$root" ] || id "$user" >/dev/null || fail "--user $user: nobody has that name here"
  if [ -z "$workspace" ]; then
    workspace=$here
    while [ "$workspace" != / ] && [ ! -f "$workspace/install/setup.bash" ]; do workspace=$(dirname "$workspace"); done
    [ "$workspace" != / ] || fail "no install/setup.bash above $here: build the workspace with colcon, or name it: --workspace FOLDER"
  fi
  [[ $workspace = /* ]] || fail "--workspace $workspace: must begin with /"
  echo "installing for the user $user, workspace $workspace:"
  put 644 "$(sed "s/^User=.*/User=$user/" "$here/flock_follower@.service")" "$unit"
  put 755 "$(cat "$here/start")" "$programs/start"
  put 755 "$(cat "$here/prefer_realtime")" "$programs/prefer_realtime"
  put 644 "$(cat "$here/61-flight-controller.rules")" "$rule"
  put 644 "$(cat "$here/05-flock_follower.conf")" "$kernel"
  # Its number is low: what others set to more, such as Cyclone DDS asks for, counts.
  if [ -z "$root" ] && [ "$(sysctl -n net.core.rmem_max)" -lt 4194304 ]; then tell sysctl --quiet --load "$kernel"; fi
  if [ -e "$settings/$name.env" ]; then
    echo "  yours, left as it is: $settings/$name.env"
  else
    local example
    example=$(cat "$here/example.env")
    example=${example/WORKSPACE_FOLDER/"$workspace"}
    # A copy, to tell at --undo whether it was changed.
    put 644 "$example" "$programs/$name.env"
    put 644 "$example" "$settings/$name.env"
  fi
  reload
  echo "next: put the topics of your camera and odometry into $settings/$name.env, then"
  echo "  sudo systemctl enable --now flock_follower@$name"
  echo "  journalctl -fu flock_follower@$name"
}

undo_all() {
  echo 'removing what was installed:'
  for file in "$settings"/*.env; do
    [ -e "$file" ] || continue
    [ -n "$root" ] || tell systemctl disable --now "flock_follower@$(basename "$file" .env).service"
    if cmp -s "$file" "$programs/$(basename "$file")"; then
      act rm "$file"
    else
      echo "  yours, left as it is: $file"
    fi
  done
  for file in "$unit" "$rule" "$kernel" "$programs"/start "$programs"/prefer_realtime "$programs"/*.env; do
    if [ -e "$file" ]; then act rm "$file"; fi
  done
  for folder in "$programs" "$settings"; do
    if [ -d "$folder" ]; then act rmdir --ignore-fail-on-non-empty "$folder"; fi
  done
  reload
  for folder in "$root/var/log/flock_follower" "$root/var/lib/flock_follower"; do
    if [ -d "$folder" ]; then echo "  yours, left as it is: $folder"; fi
  done
}

if [ -n "$undo" ]; then undo_all; else install_all; fi
