"""Files that a data set's configuration asks for and that are not there."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pdcorrect.data.config import DatasetConfig
from pdcorrect.data.plan import make_plan
from pdcorrect.data.schema import CONFIG, SUFFIX
from pdcorrect.errors import InputError


def missing_files(folder: str | Path, split: str | None = None) -> list[Path]:
    """Files that a data set's ``config.toml`` asks for and that are not there.

    None are missing where there is no configuration, as in imported data sets.

    Parameters
    ----------
    folder : path
    split : str, optional
        The only one to look at; all by default.

    Raises
    ------
    InputError
        If the configuration cannot be used.
    """
    folder = Path(folder)
    if not (folder / CONFIG).exists():
        return []
    plans = make_plan(DatasetConfig.load(folder / CONFIG))
    paths = [folder / f"{p.name}{SUFFIX}" for p in plans if split in (None, p.split)]
    return [path for path in paths if not path.exists()]


def check_whole(folder: str | Path, splits: Iterable[str]) -> None:
    """Refuse splits of which files are missing.

    Raises
    ------
    InputError
        If some are, with the first one's name, or as of `missing_files`.
    """
    for split in splits:
        accepted_gaps(folder, split, incomplete=False)


def accepted_gaps(folder: str | Path, split: str, *, incomplete: bool) -> list[Path]:
    """Files of a split that are missing, which only ``incomplete`` permits.

    It permits a configuration that cannot be used, too: none are known to be missing then.

    Raises
    ------
    InputError
        Without ``incomplete``, as of `check_whole`.
    """
    try:
        missing = missing_files(folder, split)
    except InputError:
        if not incomplete:
            raise
        return []
    if missing and not incomplete:
        raise InputError(
            f"{folder}, {split}: {len(missing)} of the files that {CONFIG} asks for are "
            f"missing, as {missing[0].name}: expected all of them ('pdcorrect dataset "
            "generate' goes on), or --incomplete for those that are there."
        )
    return missing
