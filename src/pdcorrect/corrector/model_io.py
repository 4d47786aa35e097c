"""Models on disk: a folder with ``weights.safetensors`` and ``model.json``.

``weights.safetensors`` holds the network's weights (float32) and the buffers of normaliser and
envelope (float64), all under the normaliser's name.  ``model.json`` says what they belong to:
architecture, normalisation, data set, code, training and metrics, the SHA-256 of the weights'
file, and under ``checksum`` that of all its own other content.  It is replaced last.  If a
program is ended between the two replacements, an old ``model.json`` lies beside new weights;
that, like any other damage, is refused.  Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pdcorrect._environment import home_folder
from pdcorrect._files import make_folder, part_of_process, replacing
from pdcorrect.corrector.architecture import CorrectorConfig
from pdcorrect.corrector.corrector import Corrector
from pdcorrect.corrector.model_description import (
    DESCRIPTION,
    WEIGHTS,
    Description,
    ModelRecord,
    read_description,
    read_file,
)
from pdcorrect.errors import FileFormatError, InputError, OutputError, require_extra

require_extra("safetensors", "learn")

from safetensors import SafetensorError  # noqa: E402
from safetensors import torch as safetensors  # noqa: E402

_EXPECTED = f"expected a folder with {DESCRIPTION} and {WEIGHTS}"


def model_folder(path_or_name: str | Path) -> Path:
    """Where a model given by path or name is.

    Raises
    ------
    InputError
        If there is none, or it is no path or name.
    """
    if not isinstance(path_or_name, (str, os.PathLike)) or not str(path_or_name).strip():
        raise InputError(
            f"model {path_or_name!r}: expected the name of a model or the path of its folder."
        )
    named = isinstance(path_or_name, str) and path_or_name.strip(".") != ""
    named = named and not set(str(path_or_name)) & {"/", os.sep}
    folder = models_folder() / path_or_name if named else Path(path_or_name)
    if has_model(folder):
        return folder
    if not named:
        raise InputError(f"{folder}: {_without_model(folder)}.")
    here = ", which is a folder here" if Path(path_or_name).is_dir() else ""
    raise InputError(
        f"model {path_or_name!r}: not in {models_folder()}: expected one of "
        f"{', '.join(_released()) or '(none)'}, or a path such as ./{path_or_name}{here}."
    )


def has_model(folder: Path) -> bool:
    """Whether a folder holds a model, be it half of one."""
    return any((folder / name).is_file() for name in (DESCRIPTION, WEIGHTS))


def models_folder() -> Path:
    """Where models are looked up by name.

    Raises
    ------
    InputError
        If the environment does not say, and the code is not in its checkout.
    """
    return home_folder("models", ", or the path of a model")


def unlike_ends(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of paths that are all unlike, such as "seed-1/model".

    Raises
    ------
    InputError
        If a folder comes twice.
    """
    for folder in folders:
        if folders.count(folder) > 1:
            raise InputError(f"{folder} comes twice: expected each one once.")
    longest = max((len(folder.parts) for folder in folders), default=0)
    for length in range(1, longest + 1):
        names = ["/".join(folder.parts[-length:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return []


def _without_model(path: Path) -> str:
    """What is there in place of a model's folder, and what is expected."""
    if path.is_dir():
        inner = _models_in(path)
        such_as = f", such as {path}{os.sep}{inner[0]}" if inner else ""
        return f"holds no model: {_EXPECTED}{such_as}"
    try:
        released = _released()
    except InputError:  # no models can be given by name
        released = []
    names = f", or the name of a released model: {', '.join(released)}" if released else ""
    return f"{'a file' if path.is_file() else 'not there'}: {_EXPECTED}{names}"


def _released() -> list[str]:
    return _models_in(models_folder())


def _models_in(folder: Path) -> list[str]:
    """Names of the folders in a folder that hold models."""
    return sorted(path.parent.name for path in folder.glob(f"*/{DESCRIPTION}"))


BACKWARD_EULER = "backward-euler"
"""What all data sets have, also those of models that do not record it."""

JOINT = "+"
"""Between the names of data sets that a model was trained on, together or one after another."""

_NORMALISER, _ENVELOPE = "normaliser.", "envelope."


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A corrector ready for use, and where it comes from."""

    corrector: Corrector
    record: ModelRecord

    @property
    def configuration(self) -> dict[str, Any]:
        """Of its training, as far as it is recorded."""
        training: dict[str, Any] = self.record.training
        inner = training.get("config")
        return inner if isinstance(inner, dict) else training

    @property
    def base(self) -> str:
        """Run of the coarse model that it corrects: "plain", "best" or "total-mass"."""
        return str(self.configuration.get("base", "plain"))

    @property
    def integrator(self) -> str:
        """Time integrator of the runs that it was trained on; backward Euler if not recorded."""
        return str(self.record.training.get("integrator", BACKWARD_EULER))

    @property
    def data_sets(self) -> list[tuple[str, str | None]]:
        """Names of the data sets that it was trained on, and the hashes of their configurations.

        None where a hash is not recorded.
        """
        training: dict[str, Any] = self.record.training
        if "data_sets" in training:
            return [(one["name"], one["config_hash"]) for one in training["data_sets"]]
        return [(self.record.dataset, training.get("config_hash"))]

    @property
    def velocity(self) -> Any:
        """What becomes of velocities, see `HybridStepper`."""
        return self.configuration.get("velocity", "recomputed")


# --- writing -----------------------------------------------------------------------------


def save_model(corrector: Corrector, folder: str | Path, *, record: ModelRecord) -> Path:
    """Write a model, replacing the one that is there; returns its folder.

    Both files are complete under other names before the first is replaced, so after an
    error the old model is there as it was.

    Raises
    ------
    InputError
        If the normaliser is not fitted, weights are not float32 or not finite, the network is
        another one than the corrector's configuration describes, or the record has numbers
        that are not finite.
    OutputError
        If it cannot be written.
    """
    folder = Path(folder)
    state = {
        _filed(name): tensor.detach().to("cpu").contiguous()
        for name, tensor in corrector.state_dict().items()
    }
    _check_layout(f"model for {folder}", corrector, state)
    _check_values(f"model for {folder}", state, InputError)
    weights = safetensors.save(state)
    description = Description(
        architecture=corrector.config,
        parameters=sum(tensor.numel() for tensor in corrector.parameters()),
        normalisation=_normalisation(state), record=record,
        weights_sha256=hashlib.sha256(weights).hexdigest(),
    )  # fmt: skip
    try:
        text = description.to_json()
    except ValueError as error:
        raise InputError(f"record of the model for {folder}: {error}.") from None
    make_folder(folder)
    paths = folder / WEIGHTS, folder / DESCRIPTION
    try:
        with (
            replacing(paths[1], part_of_process(paths[1])) as last,
            replacing(paths[0], part_of_process(paths[0])) as first,
        ):
            first.write_bytes(weights)
            last.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error}).") from None
    return folder


def _check_layout(where: str, corrector: Corrector, state: dict[str, Tensor]) -> None:
    """Refuse a network that could not be loaded again, for the configuration tells of another."""
    with torch.device("meta"):
        wanted = Corrector(corrector.config).state_dict()
    if {n: x.shape for n, x in state.items()} != {_filed(n): x.shape for n, x in wanted.items()}:
        raise InputError(
            f"{where}: its network is a {type(corrector.network).__name__} with other weights than "
            "its configuration describes, and could not be loaded: expected the configuration's "
            "own; keep state_dict() of others."
        )


def _filed(name: str) -> str:
    """A tensor's name in files, where ranges count as the normaliser's."""
    return name.replace(_ENVELOPE, _NORMALISER, 1) if name.startswith(_ENVELOPE) else name


def _normalisation(state: dict[str, Tensor]) -> dict[str, Any]:
    """Buffers of normaliser and envelope as numbers."""
    return {
        name.removeprefix(_NORMALISER): tensor.tolist()
        for name, tensor in sorted(state.items())
        if name.startswith(_NORMALISER)
    }


# --- reading -----------------------------------------------------------------------------


def load_model(path_or_name: str | Path, device: str | torch.device = "cpu") -> LoadedModel:
    """A saved model; the corrector is in evaluation mode.

    Parameters
    ----------
    path_or_name : str or path
        Folder, or, as a text without slashes, the name of one in ``models`` of the folder
        that the environment variable ``PDCORRECT_HOME`` names, by default of the checkout.
    device : str or torch.device

    Raises
    ------
    InputError
        If there is no such model or device.
    FileFormatError
        If a file is damaged, or the two do not belong together; names file and reason.
    FileVersionError
        If it was written in another version of the format.
    """
    folder = model_folder(path_or_name)
    path = folder / WEIGHTS
    found = read_description(folder)
    state = read_weights(folder, found)
    corrector = _empty(path, found.architecture, state)
    own = corrector.state_dict()
    _check_tensors(path, state, {_filed(name): tensor for name, tensor in own.items()})
    _check_values(str(path), state, FileFormatError)
    if found.normalisation != _normalisation(state):
        raise FileFormatError(
            f"{folder / DESCRIPTION}: its normalisation is not that of {WEIGHTS}: damaged."
        )
    moved = _moved(state, device)
    corrector.load_state_dict({name: moved[_filed(name)] for name in own}, assign=True)
    return LoadedModel(corrector.eval(), found.record)


def weights_digest(path_or_name: str | Path) -> str:
    """SHA-256 of a model's file of weights."""
    return hashlib.sha256(read_file(model_folder(path_or_name) / WEIGHTS)).hexdigest()


def read_weights(folder: Path, description: Description) -> dict[str, Tensor]:
    """The tensors in a folder, if they are those that its description is of.

    Raises
    ------
    FileFormatError
        If the file is damaged or another one.
    """
    path = folder / WEIGHTS
    data = read_file(path)
    if hashlib.sha256(data).hexdigest() != description.weights_sha256:
        raise FileFormatError(
            f"{path}: its checksum (SHA-256) is not the one in {DESCRIPTION}: it is damaged, or "
            "the program that replaced the model was ended half-way; copy or save it again."
        )
    return _tensors(path, data)


def _tensors(path: Path, data: bytes) -> dict[str, Tensor]:
    try:
        found: dict[str, Tensor] = safetensors.load(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"{path}: not a file of tensors ({error}).") from None
    return found


def _empty(path: Path, config: CorrectorConfig, state: dict[str, Tensor]) -> Corrector:
    """A corrector without values; random numbers are left alone."""
    layers = (1 if config.shared else config.layers) + config.mlp_layers
    if layers > len(state):
        raise FileFormatError(
            f"{path}: {len(state)} tensors: expected more for {config.layers} layers of networks "
            f"with {config.mlp_layers}, as {DESCRIPTION} says."
        )
    with torch.device("meta"):
        return Corrector(config)


def _check_tensors(path: Path, state: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    for what, names in (
        ("missing", expected.keys() - state.keys()),
        ("unexpected", state.keys() - expected.keys()),
    ):
        if names:
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            raise FileFormatError(
                f"{path}: {what} tensor {min(names)}{more}: the architecture in {DESCRIPTION} is "
                "another one."
            )
    for name, tensor in expected.items():
        if state[name].shape != tensor.shape:
            raise FileFormatError(
                f"{path}: {name} has shape {tuple(state[name].shape)}: expected "
                f"{tuple(tensor.shape)} for the architecture in {DESCRIPTION}."
            )


def _check_values(where: str, state: dict[str, Tensor], error: type[InputError]) -> None:
    if not float(state[f"{_NORMALISER}output_scale"]) > 0.0:
        raise error(f"{where}: its normaliser has not been fitted: it cannot be used.")
    for name, tensor in state.items():
        dtype = torch.float64 if name.startswith(_NORMALISER) else torch.float32
        if tensor.dtype != dtype:
            raise error(f"{where}: {name} has type {tensor.dtype}: expected {dtype}.")
        if not bool(torch.isfinite(tensor).all()):
            raise error(f"{where}: {name} has values that are infinite or not a number.")
        if name.endswith("_deviation") and not bool((tensor > 0.0).all()):
            raise error(f"{where}: {name} has values that are not positive.")


def _moved(state: dict[str, Tensor], device: str | torch.device) -> dict[str, Tensor]:
    try:
        return {name: tensor.to(device) for name, tensor in state.items()}
    except (RuntimeError, AssertionError) as error:
        reason = str(error).split("\n")[0]
        raise InputError(f"device {str(device)!r}: cannot be used ({reason}).") from None
