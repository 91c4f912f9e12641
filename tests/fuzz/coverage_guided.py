"""Decoders under a coverage-guided fuzzer: `python -m tests.fuzz.coverage_guided NAME [libFuzzer option ...]`.

What stops it lies in ``build/fuzz/found/NAME``; mended, it goes to ``tests/fuzz/found/NAME`` under a name of its own.
Needs the extra ``fuzz`` (atheris).
"""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

atheris: Any = import_module("atheris")

with atheris.instrument_imports(include=["drivers", "mechanics", "experiments", "planning", "rosbags", "ruamel"]):
    from tests.fuzz.decoders import DECODERS

FOLDER = Path("build/fuzz")
LIMITS = ("-timeout=5", "-rss_limit_mb=2048", "-malloc_limit_mb=200", "-max_len=65536")


def main(name: str, *options: str) -> None:
    """Try a decoder until something is found, or the options say that it is enough."""
    decoder = DECODERS[name]
    corpus, found = FOLDER / "corpus" / name, FOLDER / "found" / name
    for folder in (corpus, found):
        folder.mkdir(parents=True, exist_ok=True)
    for i, seed in enumerate(decoder.seeds()):
        (corpus / f"seed-{i}").write_bytes(seed)

    def take(data: bytes) -> None:
        with suppress(*decoder.errors):
            decoder.decode(data)

    atheris.Setup([sys.argv[0], str(corpus), f"-artifact_prefix={found}/", *LIMITS, *options], take)
    atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
