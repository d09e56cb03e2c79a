#!/bin/sh
# Make, or bring up to date, a virtual environment: make_venv.sh VENV REQUIREMENTS... (PYTHON chooses the interpreter).
# Does nothing where the environment already matches the interpreter, the pins and setup.py.
set -eu
cd "$(dirname "$0")/.."
venv=$1
shift

pins=$(cat setup.py setup.cfg "$@" | cksum; pwd)
stamp=$venv/.flock_follower
up_to_date() { [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$1" ]; }
# Any interpreter will do that made the environment before, unless one is asked for.
if [ -z "${PYTHON:-}" ] && [ -f "$stamp" ] && up_to_date "$(sed 1q "$stamp")
$pins"; then exit 0; fi

works() { "$1" -c 'import sys; raise SystemExit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1; }

# A command may be found and still not run (a version manager's shim), so each is tried.
python=${PYTHON:-}
if [ -n "$python" ]; then
  works "$python" || {
    # The shell's or a version manager's own words: "not found", "Python 3.9.2", ...
    found=$( ("$python" --version) 2>&1 | sed 1q) || true
    echo "error: PYTHON=$python is not a CPython 3.10-3.13 that runs: $found" >&2; exit 1; }
else
  for candidate in python3.12 python3.11 python3.13 python3.10; do
    if works "$candidate"; then python=$candidate; break; fi
  done
  [ -n "$python" ] || {
    echo 'error: no CPython 3.10-3.13 found: install python3.12, or name one: make PYTHON=/path/to/python3' >&2; exit 1; }
fi
"$python" -c 'import ensurepip, venv' 2>/dev/null || {
  echo "error: $python has no venv module: install it (Ubuntu, Debian: apt install python3-venv)" >&2; exit 1; }

wanted="$("$python" -c 'import sys; print(sys.executable, *sys.version.split())')
$pins"
if up_to_date "$wanted"; then exit 0; fi

echo "setting up $venv with $("$python" --version) (a minute, once)"
rm -rf "$venv"
"$python" -m venv "$venv"
log=$venv/pip.log
count=$(cat "$@" | grep -c '==') || true

# Run pip with a line every 5 s; its whole output only if it fails. PIP_USER=1 would install elsewhere.
install() {
  PIP_USER=0 PIP_QUIET=0 "$venv/bin/python" -m pip install --disable-pip-version-check --no-deps "$@" > "$log" 2>&1 &
  pip=$!
  trap 'kill "$pip" 2>/dev/null' EXIT
  trap 'exit 130' INT TERM
  seconds=0
  while kill -0 "$pip" 2>/dev/null; do
    sleep 1
    seconds=$((seconds + 1))
    if [ $((seconds % 5)) = 0 ]; then
      step=$(grep -c '^Collecting\|^Processing\|^Obtaining' "$log") || true
      if grep -q '^Installing' "$log"; then step='all'; fi
      echo "  $seconds s: $step of at most $count packages fetched"
    fi
  done
  wait "$pip" || { cat "$log" >&2; echo "error: pip failed, see above" >&2; exit 1; }
  trap - EXIT
}

requirements=$(printf -- '-r %s ' "$@")
# shellcheck disable=SC2086
install $requirements
case $* in */lock-*) install --no-build-isolation -e . ;; esac
printf '%s\n' "$wanted" > "$stamp"
