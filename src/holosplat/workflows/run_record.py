"""What the files of a run say of it in numbers: entries of config.json and summary.json."""

from __future__ import annotations

from typing import Any

from ..backends import device_name
from ..fit.running import Running
from ..geometry import Grid
from ..matter import MaterialPrior, MatterKind
from ..methods import Method
from ..methods.presets import SCHEMA
from ..scan import Scan
from ..tables import to_table
from .provenance import scan_hash
from .reconstruction import Reconstruction


def summary_of(done: Reconstruction, fit: Running | None, train: Scan) -> dict[str, Any]:
    """Entries of summary.json; fit: the last one, if there was any."""
    (h, w), matter = train.views.shape, done.object.matter
    backend = fit.backend if fit else done.object.backend
    second = matter.second and {"delta": matter.second.delta, "beta": matter.second.beta}
    return {
        "finished": done.finished,
        "method": done.method,
        **done.choice.as_dict(),
        "kind": done.object.kind,
        "size": done.object.described,
        "backend": backend,
        "device": device_name(backend),
        "steps": fit.step if fit else 0,
        "stopped_early": bool(fit and fit.stopped_early),
        "best_step": (fit.best_step or fit.step) if fit else 0,
        "oversample": done.oversample,
        "detector": {
            **{"rows": h, "columns": w, "pixel_size_m": train.views.finest},
            "centre_m": Grid.of_views(train.views).centre.tolist(),
        },
        "energy_kev": done.energy_kev,
        "material": {
            "delta": matter.delta,
            "beta": matter.beta,
            "single": matter.single,
            "delta_told": done.delta_told,
        },
        "second_material": second,
        "timing_s": done.timing,
        "constants": [to_table(each) for each in done.constants],
        **({"verdict": done.verdict.as_dict()} if done.verdict else {}),
        **({"total": done.total.as_dict()} if done.total else {}),
    }


def config_of(scan: Scan, prior: MaterialPrior, method: Method, seed: int, matter: MatterKind | None) -> dict[str, Any]:
    """Entries of config.json that say what a run is of."""
    return {
        "schema_version": SCHEMA,
        "method": to_table(method),
        "prior": prior.as_dict(),
        "matter": matter or "auto",
        "seed": seed,
        "scan_hash": scan_hash(scan),
    }
