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
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field, JsonValue, ValidationError
from torch import Tensor

from pdcorrect._config import Strict
from pdcorrect._environment import code_digest, home_folder
from pdcorrect._files import make_folder, part_of_process, replacing
from pdcorrect._version import __version__
from pdcorrect.corrector.corrector import Corrector, CorrectorConfig
from pdcorrect.errors import (
    FileFormatError,
    FileVersionError,
    InputError,
    OutputError,
    require_extra,
)

require_extra("safetensors", "learn")

from safetensors import SafetensorError  # noqa: E402
from safetensors import torch as safetensors  # noqa: E402

FORMAT = "pdcorrect-model"
VERSION = 1
WEIGHTS, DESCRIPTION = "weights.safetensors", "model.json"

_CHECKSUM = "checksum"


class ModelRecord(Strict):
    """Where a model comes from.

    Attributes
    ----------
    dataset, dataset_hash
        Name of the data set, or names of several with a plus sign between them; and the hash of
        the configuration or content of what its last training learned.
    training, metrics
        Settings of the training, and what the model achieved; any JSON with finite numbers.
    code_version, code_digest
        Of the code that made it, see `pdcorrect._environment.code_digest`.
    """

    dataset: str
    dataset_hash: str
    training: dict[str, JsonValue] = Field(default_factory=dict)
    metrics: dict[str, JsonValue] = Field(default_factory=dict)
    code_version: str = __version__
    code_digest: str = Field(default_factory=code_digest)


class Description(Strict):
    """``model.json`` without its checksum."""

    format: Literal["pdcorrect-model"] = "pdcorrect-model"
    version: int = VERSION
    architecture: CorrectorConfig
    parameters: int
    dtype: Literal["float32"] = "float32"
    normalisation: dict[str, list[float] | float]
    record: ModelRecord
    weights_sha256: str

    def to_json(self) -> str:
        """The file's text; a ValueError if a number is not finite."""
        content = self.model_dump(mode="json")
        whole = {**content, _CHECKSUM: content_digest(content)}
        return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def content_digest(content: dict[str, Any]) -> str:
    """SHA-256 of JSON content, however it is laid out."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def read_description(folder: Path) -> Description:
    """What ``model.json`` in a folder says; for errors see `load_model`."""
    path = folder / DESCRIPTION
    try:
        content = json.loads(_read(path).decode("utf-8"))
        whole = content.pop(_CHECKSUM, None) == content_digest(content)
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise FileFormatError(f"{path}: damaged: not JSON of a model ({error}).") from None
    if content.get("format") != FORMAT:
        raise FileFormatError(f"{path}: expected format {FORMAT!r}: damaged or something else.")
    version = content.get("version")
    newer = type(version) is int and version > VERSION  # whose checksum may be another one
    if not whole and not newer:
        raise FileFormatError(
            f"{path}: damaged: its checksum is not that of its content; copy or save it again."
        )
    if type(version) is not int or version != VERSION:
        remedy = "update pdcorrect" if newer else "train the model anew"
        raise FileVersionError(f"{path}: format version {version!r}: expected {VERSION}: {remedy}.")
    try:
        return Description.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise FileFormatError(f"{path}: {place}: {first['msg']}.") from None


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror or error}).") from None


# --- where models are ----------------------------------------------------------------------


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
    if any((folder / name).is_file() for name in (DESCRIPTION, WEIGHTS)):
        return folder
    if not named:
        raise InputError(
            f"{folder}: holds no model: expected a folder with {DESCRIPTION} and {WEIGHTS}."
        )
    known = sorted(path.parent.name for path in models_folder().glob(f"*/{DESCRIPTION}"))
    raise InputError(
        f"model {path_or_name!r}: not in {models_folder()}: expected one of "
        f"{', '.join(known) or '(none)'}, or a path such as ./{path_or_name}."
    )


def models_folder() -> Path:
    """Where models are looked up by name."""
    return home_folder("models", ", or give the path of a model")


def unlike_ends(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of paths that are all unlike, such as "seed-1/model".

    A folder that comes twice is an `InputError`.
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


BACKWARD_EULER = "backward-euler"
"""Of the runs of models that do not record it."""

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
    with torch.device("meta"):
        wanted = Corrector(corrector.config).state_dict()
    if _layout(state) != _layout(wanted):
        raise InputError(
            f"model for {folder}: its {type(corrector.network).__name__} has other weights than "
            "its configuration describes, and could not be loaded: keep its state_dict()."
        )
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


def _layout(state: dict[str, Tensor]) -> dict[str, torch.Size]:
    """Shapes of a corrector's tensors by their names in files."""
    return {_filed(name): tensor.shape for name, tensor in state.items()}


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
        that the environment variable ``PDCORRECT_HOME`` names, by default of the checkout;
        a wheel has no models, the source archive has.
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
    data = _read(path)
    if hashlib.sha256(data).hexdigest() != found.weights_sha256:
        raise FileFormatError(
            f"{path}: its checksum (SHA-256) is not the one in {DESCRIPTION}: it is damaged, or "
            "the program that replaced the model was ended half-way; copy or save it again."
        )
    try:
        state: dict[str, Tensor] = safetensors.load(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"{path}: not a file of tensors ({error}).") from None
    config = found.architecture
    if config.layers + config.mlp_layers > len(state):
        raise FileFormatError(
            f"{path}: {len(state)} tensors: expected more for the architecture in {DESCRIPTION}."
        )
    with torch.device("meta"):  # random numbers are left alone
        corrector = Corrector(config)
    own = corrector.state_dict()
    different = {name for name, _ in _layout(state).items() ^ _layout(own).items()}
    if different:
        raise FileFormatError(
            f"{path}: tensor {min(different)} is missing, unexpected or of another shape than by "
            f"the architecture in {DESCRIPTION}."
        )
    _check_values(str(path), state, FileFormatError)
    if found.normalisation != _normalisation(state):
        raise FileFormatError(
            f"{folder / DESCRIPTION}: its normalisation is not that of {WEIGHTS}: damaged."
        )
    try:
        moved = {name: tensor.to(device) for name, tensor in state.items()}
    except (RuntimeError, AssertionError) as error:
        reason = str(error).split("\n")[0]
        raise InputError(f"device {str(device)!r}: cannot be used ({reason}).") from None
    corrector.load_state_dict({name: moved[_filed(name)] for name in own}, assign=True)
    return LoadedModel(corrector.eval(), found.record)


def weights_digest(path_or_name: str | Path) -> str:
    """SHA-256 of a model's file of weights."""
    return hashlib.sha256(_read(model_folder(path_or_name) / WEIGHTS)).hexdigest()


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
