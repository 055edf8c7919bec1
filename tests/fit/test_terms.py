"""Terms by name: one more of them in a fit, and what is expected of alignment and light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from helpers.fit_balls import a_cloud, cloud_of, fit_of, run
from holosplat.checks import InputError
from holosplat.fit.problem import FIXED, Batch, LossPart
from holosplat.fit.terms import TERMS
from holosplat.fit.terms.frames import EXPECTED
from holosplat.geometry import Views
from holosplat.methods import ExtraTerm
from holosplat.model import Alignment, Instrument, LightField, Model, smooth_modes
from holosplat.representations import GaussianCloud
from holosplat.scan import Exposures, Scan

BATCH = Batch(None, torch.zeros(3, dtype=torch.float64), torch.tensor(0.5), 0)


@dataclass(frozen=True)
class Mass:
    """The mean amplitude."""

    weight: float
    names = ("mass",)
    resolved = FIXED

    def __call__(self, model: Model, batch: Batch) -> list[LossPart]:
        assert isinstance(model.object, GaussianCloud)
        return [LossPart("mass", self.weight, model.object.amplitudes.mean())]


@pytest.fixture
def mass(monkeypatch):
    """A term that somebody adds; it sees the model and the training frames."""
    seen: list[tuple[Model, Scan]] = []

    def build(weight: float, model: Model, train: Scan) -> Mass:
        seen.append((model, train))
        return Mass(weight)

    monkeypatch.setitem(TERMS, "mass", build)
    return seen


def test_a_term_by_name_joins_the_loss_and_changes_the_fit(scan, mass):
    fits = [fit_of(scan, steps=20, terms=terms) for terms in ((), (ExtraTerm("mass", 0.0),), (ExtraTerm("mass", 3.0),))]
    plain, idle, heavy = map(run, fits)
    assert "mass" not in plain[0]
    assert all(record["loss"] == pytest.approx(record["frames"] + 3 * record["mass"], rel=1e-6) for record in heavy)
    assert [record["frames"] for record in idle] == [record["frames"] for record in plain]
    assert heavy[-1]["mass"] < 0.97 * idle[-1]["mass"]
    assert "mass" in fits[2].columns()
    with torch.no_grad():
        assert heavy[0]["mass"] == pytest.approx(float(a_cloud().amplitudes.mean()), rel=1e-6)
        assert float(cloud_of(fits[2]).amplitudes.mean()) < float(cloud_of(fits[1]).amplitudes.mean())


def test_a_term_is_built_of_the_model_and_the_frames_that_are_fitted(scan, mass):
    fit = fit_of(scan, steps=1, validation_views=2, terms=(ExtraTerm("mass"),))
    ((model, train),) = mass
    assert model is fit.plan.problem.model
    assert len(train) == len(scan.train()) - 2


def test_terms_that_are_not_there_are_refused():
    with pytest.raises(InputError, match="a term must be one of alignment_prior, light_prior, but it is 'entropy'"):
        ExtraTerm("entropy")
    with pytest.raises(InputError, match="weight of the term light_prior must not be negative, but it is -1"):
        ExtraTerm("light_prior", -1.0)


# --- what is expected ---------------------------------------------------------------------------------------


def a_model() -> Model:
    """A cloud in three exposures that may be off in every way."""
    exposures = Exposures.of(Views.evenly_spaced(3, (7, 9), 2e-6), 20.0, 0.02)
    alignment = Alignment.planned(3, "turns", "shifts", "stretches", "blurs")
    return Model(a_cloud(), Instrument(exposures), alignment, LightField.even(3, smooth_modes((7, 9), 1)))


def value(name: str, weight: float, model: Model, scan: Scan) -> tuple[float, dict[str, torch.Tensor]]:
    """The weighted term, and its gradients."""
    leaves = {key: p.clone().requires_grad_() for key, p in model.parameters().items()}
    (part,) = TERMS[name](weight, model, scan)(model.with_parameters(leaves), BATCH)
    assert part.name == name
    loss = part.weight * part.value
    loss.backward()
    return float(loss.detach()), {key: leaf.grad for key, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.parametrize(("name", "prefix"), [("alignment_prior", "alignment."), ("light_prior", "light.")])
def test_what_is_as_far_off_as_expected_costs_half_a_number(scan, name, prefix):
    model = a_model()
    assert value(name, 2.0, model, scan)[0] == 0
    own = {key: p for key, p in model.parameters().items() if key.startswith(prefix)}
    assert own
    off = {key: torch.full_like(p, -2 * EXPECTED[key]) for key, p in own.items()}
    cost, gradients = value(name, 3.0, model.with_parameters(off), scan)
    assert cost == pytest.approx(3 * 0.5 * 4 * sum(p.numel() for p in own.values()), rel=1e-6)
    assert set(gradients) == set(own)
    for key, gradient in gradients.items():
        torch.testing.assert_close(gradient, torch.full_like(gradient, -3 * 2 / EXPECTED[key]), rtol=1e-6, atol=0)


@pytest.mark.parametrize(("name", "part"), [("alignment_prior", "alignment"), ("light_prior", "light")])
def test_a_prior_of_what_the_model_has_not_is_refused(scan, name, part):
    without = replace(a_model(), **{part: None})
    with pytest.raises(InputError, match=rf"the term {name} needs a model with {part}\.\*, but it has object\.centres"):
        TERMS[name](1.0, without, scan)
