#!/usr/bin/env bash
# Compiles the two lock files from pyproject.toml, and tries each; run by `make lock`.
set -euo pipefail
cd "$(dirname "$0")/.."
compile=(.venv/bin/uv pip compile -q --no-annotate --no-header --no-emit-index-url)

# Versions locked before stay, where pyproject.toml still permits them.
{
  echo "# All that pyproject.toml's extras bring, as tested together on Python 3.11: PyPI mixes ROS"
  echo "# Jazzy with later distributions. Made by make lock."
  "${compile[@]}" --python-version 3.11.7 --all-extras -c requirements/lock.txt pyproject.toml
} >requirements/lock.new
mv requirements/lock.new requirements/lock.txt

{
  echo "# For a virtual environment on an apt Jazzy (Ubuntu 24.04), whose NumPy and SciPy these are: its"
  echo "# messages are compiled against NumPy 1.26, which NumPy 2 would break. No rerun, which requires"
  echo "# NumPy 2. Made by make lock."
  # pyarrow 26 refuses NumPy 1.26 when it is imported; nothing in its metadata says so
  printf 'numpy==1.26.4\nscipy==1.11.4\npyarrow<26\n' |
    "${compile[@]}" --python-version 3.11.7 --extra study -c - pyproject.toml
} >requirements/workstation.new
mv requirements/workstation.new requirements/workstation.txt

# What a resolver accepts may still not work together.
for name in workstation lock; do
  rm -rf "build/try_$name"
  .venv/bin/uv venv -q --python .venv/bin/python "build/try_$name"
  .venv/bin/uv pip install -q --python "build/try_$name/bin/python" -r "requirements/$name.txt"
  "build/try_$name/bin/python" tools/try_packages.py "requirements/$name.txt"
done
