"""docs/adding.md does what it says: its method and its term are one file and one line each, and run."""

from __future__ import annotations

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from holosplat.baselines import HolographicTV
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.cli import main
from holosplat.fit import terms
from holosplat.fit.problem import Batch
from holosplat.geometry import Grid, Views
from holosplat.io.nxtomo import write_scan
from holosplat.io.objects import read_object
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods import METHODS, ExtraTerm, PerView, Task, VoxelFit, Voxels, solve
from holosplat.model import Instrument, Model
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

pytestmark = pytest.mark.usefixtures("unjudged_runs", "plain_light", "undrawn_reports")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "adding.md"
PIXEL = 3.2e-6
CELL = HAEMOGLOBIN.delta_beta(20.0)
KNOWN = MaterialPrior.known(CELL)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Six views of three cells, 24 × 28 pixels."""
    views = Views.evenly_spaced(6, shape=(24, 28), pixel_size=PIXEL)
    cells = random_cells(3, (views.width, views.height, views.width), 1, 12 * PIXEL)
    return simulate(MeshScene.of_one_material(cells, CELL), Exposures.of(views, 20.0, 0.1))


def section(title: str) -> tuple[str, str]:
    """(the file, the line of the table) that a section of the page shows."""
    text = PAGE.read_text(encoding="utf-8").split(f"## {title}\n")[1].split("\n## ")[0]
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    line = re.search(r"In `[A-Z]+` of `[\w/.]+`, the line `(.*?)`\.", text)
    assert code is not None
    assert line is not None
    return code[1], line[1]


def loaded(monkeypatch: pytest.MonkeyPatch, folder: Path, room: str, name: str, text: str) -> ModuleType:
    """The module `name` of the room, from a file of `folder`."""
    path = folder / f"{name}.py"
    path.write_text(text, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(f"holosplat.{room}.{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def entry(line: str, module: ModuleType) -> tuple[str, object]:
    """Name and value of the table's line, in the module's names."""
    (item,) = eval(f"{{{line}}}", vars(module)).items()
    return item


def test_a_method_is_one_file_and_one_line(tmp_path, monkeypatch, scan):
    """Library and command line run the method of the page, and read, score and export its result."""
    code, line = section("A method")
    module = loaded(monkeypatch, tmp_path, "methods", "thresholded", code)
    name, method = entry(line, module)
    monkeypatch.setitem(METHODS.own, name, method)
    plain = solve(PerView("tikhonov", "tv"), Task(scan.train(), KNOWN))
    found = solve(method, Task(scan.train(), KNOWN))
    assert set(found.values.unique().tolist()) == {0.0, 1.0}
    assert torch.equal(found.values, (plain.values > 0.5).to(plain.values))
    with pytest.raises(InputError, match="level must"):
        replace(method, level=2.0)

    write_scan(tmp_path / "scan.nxs", scan)
    run = tmp_path / "run"
    matter = ["--material", "haemoglobin"]
    monkeypatch.setattr(
        sys, "argv", ["holosplat", "reconstruct", f"{tmp_path}/scan.nxs", "--method", name, *matter, "--out", str(run)]
    )
    main()
    assert torch.equal(read_object(run / "object.h5").values, found.values)
    monkeypatch.setattr(sys, "argv", ["holosplat", "export", str(run), "--volume", f"{tmp_path}/volume.h5"])
    main()
    assert (tmp_path / "volume.h5").is_file()


def test_a_term_is_one_file_and_one_line(tmp_path, monkeypatch, scan):
    """A fit takes the term of the page by name, and ends with less matter the larger its weight."""
    code, line = section("A term")
    with pytest.raises(InputError, match="a term must be one of"):
        ExtraTerm("sparsity")
    name, build = entry(line, loaded(monkeypatch, tmp_path, "fit.terms", "sparsity", code))
    monkeypatch.setitem(terms.TERMS, name, build)
    quick = HolographicTV(iterations=30, corrections=1, inner=8, refine=1)
    plain = Voxels(volume=quick, fit=VoxelFit(steps=5, refine=1))
    sparse = replace(plain, fit=replace(plain.fit, terms=(ExtraTerm(name, 1000.0),)))
    without, with_it = (solve(method, Task(scan.train(), KNOWN)).values.sum() for method in (plain, sparse))
    assert 0 < with_it < 0.9 * without


def test_the_term_of_the_page_is_right(tmp_path, monkeypatch, scan):
    """Its gradient is that of finite differences, and an object without voxels is refused by name."""
    code, line = section("A term")
    _, build = entry(line, loaded(monkeypatch, tmp_path, "fit.terms", "sparsity", code))
    grid = Grid.of_views(scan.views)
    drawn = torch.randn((1, *grid.shape), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    values = drawn + 0.5 * drawn.sign()  # no step crosses the kink at zero
    batch = Batch(None, torch.zeros(3, dtype=torch.float64), torch.tensor(0.0), volume=0)
    model = Model(VoxelGrid(values, grid, Matter.one(*CELL)), Instrument(scan.exposures))

    def loss(at: torch.Tensor) -> torch.Tensor:
        (part,) = build(2.0, model, scan)(model.with_parameters({"object.values": at}), batch)
        return part.weight * part.value

    free = values.clone().requires_grad_()
    loss(free).backward()
    assert free.grad is not None
    step = 1e-4 * torch.randn(values.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    change = (loss(values + step) - loss(values - step)) / 2
    assert float((free.grad * step).sum()) == pytest.approx(float(change), rel=1e-4)
    with pytest.raises(InputError, match="the term sparsity needs voxels"):
        build(1.0, replace(model, object=MeshScene.of_one_material(random_cells(1, (1e-4,) * 3, 1), CELL)), scan)
