#!/usr/bin/env bash
# One would guess: where the docstring of a field or of a parameter is wrapped in the source does not show in `--help`,
# as with comments above a field, whose lines tyro joins.
# What happens: docstring_parser leaves the second line's indentation, tyro takes an indented line for one that shall
# stay, and help texts break in the middle of a sentence, wherever the source was wrapped.
# For this field: configs of training scripts are dataclasses with a docstring per field.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet tyro==1.0.17 docstring-parser==0.18.0
cat > "$tmp/script.py" << 'PY'
from dataclasses import dataclass

import tyro


@dataclass
class Config:
    steps: int = 1
    """Gradient steps of the
    whole run."""
    # Rows per
    # window.
    rows: int = 1


def train(batch: int = 1) -> None:
    """Train.

    Args:
        batch: Windows per
            batch.
    """


tyro.cli(Config, args=["--help"]) if __import__("sys").argv[1:] == ["config"] else tyro.cli(train, args=["--help"])
PY
export COLUMNS=100
"$tmp/venv/bin/python" -c "import tyro; print('tyro', tyro.__version__)"
"$tmp/venv/bin/python" "$tmp/script.py" config > "$tmp/config"
"$tmp/venv/bin/python" "$tmp/script.py" function > "$tmp/function"
grep -A1 -e "--steps" -e "--rows" "$tmp/config"
grep -A1 -e "--batch" "$tmp/function"
grep -q "Rows per window" "$tmp/config"
if grep -q "of the whole run" "$tmp/config" || grep -q "Windows per batch" "$tmp/function"; then
    echo "lines of docstrings are joined, too"
    exit 1
fi
