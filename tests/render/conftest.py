"""What tests of building share: a compiler that does not take its time."""

from __future__ import annotations

import pytest

from aquaflow.render.native import build as native


@pytest.fixture(scope="session")
def quick_compiler(tmp_path_factory: pytest.TempPathFactory) -> str:
    """$CXX for kernels that are built to be there, not to be fast: the last -O counts."""
    compiler = native.find_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler")
    script = tmp_path_factory.mktemp("quick_compiler") / "g++"
    script.write_text(f'#!/bin/sh\nexec {" ".join(compiler)} "$@" -O0\n')
    script.chmod(0o755)
    return str(script)
