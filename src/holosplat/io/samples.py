"""Public sample data: a list with sources and checksums, fetched into a cache by pooch, or taken from a folder."""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

from ..checks import InputError, require
from ..tables import from_table, read_table
from .atomic import atomic_folder, atomic_path
from .provenance import sha256 as file_sha256

SAMPLES = Path(__file__).with_name("samples.toml")
CACHE = "HOLOSPLAT_DATA"
"""Environment variable that names another folder for what is fetched."""
TIMEOUT_S = 30
"""A server that is silent for so long is taken to be out of reach."""


@dataclass(frozen=True)
class Sample:
    """One public data set.

    title, source, licence, facts: in words. file, local: its name there, and in a folder of one's own.
    url: where it is fetched from; None where only a folder can have it. sha256, bytes: of the file.
    options: what commands are told of it. inner: the folder to take inside an archive. angles: of its views [degrees].
    next: a command to go on with, `{data}` being the path and the options.
    """

    title: str
    file: str
    source: str
    licence: str
    sha256: str
    bytes: int
    facts: str
    next: str
    options: tuple[str, ...] = ()
    url: str | None = None
    local: str | None = None
    inner: str | None = None
    angles: tuple[float, ...] = ()


def samples() -> dict[str, Sample]:
    """The samples by name."""
    return {name: from_table(Sample, table, name) for name, table in read_table(SAMPLES).items()}


def sample(name: str) -> Sample:
    """The sample `name`; `InputError` for another one."""
    known = samples()
    if name not in known:
        raise InputError(f"there is no sample {name!r}; holosplat data list has {', '.join(known)}.")
    return known[name]


def cache() -> Path:
    """The folder that samples are fetched into: $HOLOSPLAT_DATA, or the system's place for caches."""
    import pooch

    return Path(os.environ.get(CACHE) or pooch.os_cache("holosplat"))


def fetched(wanted: Sample, folder: Path | None = None) -> tuple[Path, list[str]]:
    """The path of a sample, and the options that say what is known of it.

    folder: where the file lies already; else it is fetched, unless the cache has it. Its checksum is always compared.
    What an archive holds is unpacked into the cache. Errors: `InputError` for a file that is missing, cannot be
    fetched, or has another checksum.
    """
    found = _in_folder(wanted, folder) if folder is not None else _downloaded(wanted)
    options = [*wanted.options]
    if wanted.angles:
        angles = cache() / f"{wanted.sha256[:8]}-angles.txt"
        angles.parent.mkdir(parents=True, exist_ok=True)
        if not angles.is_file():
            with atomic_path(angles) as temporary:
                temporary.write_text("".join(f"{angle:g}\n" for angle in wanted.angles), encoding="utf-8")
        options += ["--angles", str(angles)]
    return (_unpacked(found, wanted.inner, wanted.sha256) if wanted.inner else found), options


def _in_folder(wanted: Sample, folder: Path) -> Path:
    names = [name for name in (wanted.file, wanted.local) if name]
    found = next((folder / name for name in names if (folder / name).is_file()), None)
    if found is None:
        raise InputError(f"{folder} must hold {' or '.join(names)}, but it does not; check --from.")
    digest = file_sha256(found)
    require(
        digest == wanted.sha256,
        f"{found} must have the SHA-256 {wanted.sha256[:16]}…, but has {digest[:16]}…: it is damaged or another file.",
    )
    return found


def _downloaded(wanted: Sample) -> Path:
    import pooch
    import requests

    if wanted.url is None:
        raise InputError(
            f"{wanted.file} is not to be fetched whole: it was made from {wanted.source}; name a folder that has it by "
            "--from."
        )
    pooch.get_logger().setLevel("WARNING")
    load = pooch.HTTPDownloader(timeout=TIMEOUT_S)
    try:
        found = pooch.retrieve(wanted.url, f"sha256:{wanted.sha256}", wanted.file, cache(), downloader=load)  # type: ignore[arg-type]
    except requests.exceptions.HTTPError as error:
        raise InputError(f"{wanted.url} must give {wanted.file}, but the server answers: {error}.") from None
    except requests.exceptions.RequestException:
        raise InputError(
            f"{wanted.url} cannot be reached; check the network, or name a folder that has {wanted.file} by --from."
        ) from None
    except ValueError:
        raise InputError(
            f"{wanted.url} must give a file with the SHA-256 {wanted.sha256[:16]}…, but it gives another one; nothing "
            "was kept. Try again, for it may have been cut off."
        ) from None
    except OSError as error:
        raise InputError(f"{cache()} must be writable, but writing to it failed: {error}; set {CACHE}.") from None
    return Path(found)


def _unpacked(archive: Path, inner: str, sha256: str) -> Path:
    """The folder `inner` of a ZIP archive, in the cache; it appears there whole, or not at all."""
    target = cache() / f"{archive.stem}-{sha256[:8]}"
    if not target.is_dir():
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with atomic_folder(target) as temporary, zipfile.ZipFile(archive) as opened:
                opened.extractall(temporary)
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
            raise InputError(f"{archive} must be a ZIP archive, but it is damaged or none: {error}.") from None
    return target / inner
