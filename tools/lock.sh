#!/usr/bin/env bash
# Compiles the two lock files from pyproject.toml, and tries each; run by `make lock`.
# What is locked stays as long as pyproject.toml permits it; with --all, each package gets its latest version.
set -euo pipefail
cd "$(dirname "$0")/.."
upgrade=()
case "${1:-}" in
  "") ;;
  --all) upgrade=(--upgrade) ;;
  *) echo "usage: tools/lock.sh [--all]" >&2; exit 2 ;;
esac

# lock FILE COMMENT ARGUMENT...: constraints come from the standard input
lock() {
  local file=$1 comment=$2
  shift 2
  local new=$file.new
  cp "$file" "$new"  # uv keeps what is pinned in the file that it writes
  .venv/bin/uv pip compile -q --no-annotate --no-header --no-emit-index-url --generate-hashes --python-version 3.11.0 \
    "${upgrade[@]}" "$@" -c - -o "$new" pyproject.toml
  { echo "$comment"; cat "$new"; } >"$file"
  rm "$new"
}

lock requirements/lock.txt \
  "# All that pyproject.toml's extras bring, as tested together on Python 3.11: PyPI mixes ROS
# Jazzy with later distributions. Made by make lock." --all-extras </dev/null

printf 'numpy==1.26.4\nscipy==1.11.4\n' | lock requirements/workstation.txt \
  "# For a virtual environment on an apt Jazzy (Ubuntu 24.04), whose NumPy and SciPy these are: its
# messages are compiled against NumPy 1.26, which NumPy 2 would break. No rerun, which requires
# NumPy 2. Made by make lock." --extra study

# What a resolver accepts may still not work together.
for name in workstation lock; do
  rm -rf "build/try_$name"
  .venv/bin/uv venv -q --python .venv/bin/python "build/try_$name"
  .venv/bin/uv pip install -q --python "build/try_$name/bin/python" -r "requirements/$name.txt"
  "build/try_$name/bin/python" tools/try_packages.py "requirements/$name.txt"
done
