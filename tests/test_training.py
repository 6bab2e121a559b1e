"""Loss and assignment by hand, and a short training that lowers the loss; `make test-train`."""

import json
import subprocess
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.train

from twin.layout import load_layout, models_dir  # noqa: E402
from twin.stack.config import nominal_config  # noqa: E402
from twin.stack.detection.boxes import read_maps  # noqa: E402
from twin.training import loop  # noqa: E402
from twin.training.ablation import DESIGNS  # noqa: E402
from twin.training.export import known  # noqa: E402
from twin.training.loop import Plan, fit, load_weights, save_weights  # noqa: E402
from twin.training.loss import (  # noqa: E402
    LEVEL_SIZE,
    Target,
    assign,
    ciou,
    decode,
    encode,
    loss,
)
from twin.training.network import Design, Detector, parameters  # noqa: E402
from twin.training.second_look import NOTHING, SecondLook, train_second_look  # noqa: E402
from twin.training.train import train  # noqa: E402

layout = load_layout()
WEIGHTS = models_dir() / "detector" / "weights.npz"
config = nominal_config(layout.site, layout.options)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Folder of twenty pictures."""
    folder = tmp_path_factory.mktemp("set")
    # In a process of its own: Mesa's renderer crashes where PyTorch was loaded before it.
    code = (
        "import sys; from pathlib import Path; from twin.layout import load_layout\n"
        "from twin.training.dataset import make_set; from twin.training.domain import TRAINING\n"
        "make_set(Path(sys.argv[1]), load_layout(), TRAINING, 0, 20)"
    )
    subprocess.run([sys.executable, "-c", code, str(folder)], check=True)
    return folder


def target(*boxes, ignored=()) -> Target:
    return Target(
        torch.tensor([b for _, b in boxes], dtype=torch.float32).reshape(-1, 4),
        torch.tensor([c for c, _ in boxes], dtype=torch.long),
        torch.tensor(ignored, dtype=torch.float32).reshape(-1, 4),
    )


def test_a_small_part_belongs_to_the_cells_within_six_pixels_of_its_centre():
    t = target((2, (30, 30, 50, 50)))  # centre 40, 40; the middles of cells 9 and 10: 38 and 42
    owner, empty = assign(t, 4, 0.0, 32, 32)
    cells = torch.nonzero(owner == 0).tolist()
    assert cells == [[v, u] for v in (9, 10) for u in (9, 10)]
    assert not empty[owner == 0].any() and empty.sum() == 32 * 32 - len(cells)
    assert (assign(t, 16, 64.0, 8, 8)[0] < 0).all()


def test_a_large_part_belongs_to_the_coarse_map():
    t = target((1, (0, 0, 90, 60)))
    assert (assign(t, 4, 0.0, 32, 32)[0] < 0).all()
    assert (assign(t, 16, 64.0, 8, 8)[0] == 0).any()


def test_hardly_seen_parts_are_neither_there_nor_empty():
    owner, empty = assign(target(ignored=[(0, 0, 16, 16)]), 4, 0.0, 8, 8)
    assert (owner < 0).all()
    assert not empty[:4, :4].any() and empty[4:, :].all()


def test_the_nearer_of_two_parts_gets_the_cell():
    t = target((0, (0, 0, 16, 16)), (1, (8, 0, 24, 16)))
    owner, _ = assign(t, 4, 0.0, 8, 8)
    assert owner[2, 1] == 0 and owner[2, 4] == 1


def test_ciou_by_hand():
    a = torch.tensor([[0.0, 0, 10, 10]])
    assert ciou(a, a).item() == pytest.approx(1.0, abs=1e-4)
    b = torch.tensor([[5.0, 0, 15, 10]])  # IoU 1/3; centres 5 apart, hull 15 x 10
    assert ciou(a, b).item() == pytest.approx(1 / 3 - 25 / 325, abs=1e-4)
    far = torch.tensor([[100.0, 0, 110, 10]])
    assert -1 < ciou(a, far).item() < 0
    # One centre, IoU 100 / 300. v = 4 / pi^2 (atan 2 - atan 1/2)^2 = 0.16783, which counts
    # v / (1 - IoU + v) = 0.20111 times: 1/3 - 0.03375.
    lying, standing = torch.tensor([[0.0, 0, 20, 10]]), torch.tensor([[5.0, -5, 15, 15]])
    assert ciou(lying, standing).item() == pytest.approx(0.29958, abs=1e-4)


def test_ciou_properties():
    rng = torch.Generator().manual_seed(0)
    low = torch.rand(200, 2, generator=rng) * 50
    a = torch.cat([low, low + 1 + torch.rand(200, 2, generator=rng) * 40], dim=1)
    b = a[torch.randperm(200, generator=rng)]
    value = ciou(a, b)
    assert (value <= 1 + 1e-5).all() and (value > -2).all()
    torch.testing.assert_close(value, ciou(b, a), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(value, ciou(a * 3 + 7, b * 3 + 7), rtol=1e-3, atol=1e-3)


def test_the_stack_reads_what_the_loss_trains():
    raw = torch.zeros(1, 10, 80, 104)
    raw[:, 4] = -20
    v, u = torch.tensor([12]), torch.tensor([30])
    box = torch.tensor([[100.0, 40, 141, 63]])
    raw[0, :4, v, u] = encode(box, v, u, 4).T
    raw[0, 4, v, u] = 9.0
    raw[0, 8, v, u] = 9.0
    torch.testing.assert_close(decode(raw, 4)[0, 12, 30], box[0])
    empty = [np.full((20, 26, 10), -20.0), np.full((10, 13, 10), -20.0)]
    boxes = read_maps([raw[0].permute(1, 2, 0).numpy(), *empty], 416, 0.5)
    np.testing.assert_allclose(boxes.box, box.numpy(), atol=1e-3)
    assert boxes.part_class.tolist() == [3]


@pytest.mark.parametrize("ciou_on", [True, False])
def test_loss_falls_to_nothing_for_a_perfect_answer(ciou_on):
    design = Design(ciou=ciou_on)
    t = target((3, (20, 20, 50, 44)))
    maps = [torch.zeros(1, 10, 128 // s, 128 // s) for s in (4, 16, 32)]
    for m in maps:
        m[:, 4] = -12.0
    before = loss(maps, [t], design)
    assert before["object"] == pytest.approx(12.0, abs=1e-3)  # softplus(12) a cell that says no
    owner, _ = assign(t, 4, 0.0, 32, 32)
    v, u = torch.nonzero(owner == 0, as_tuple=True)
    boxes = t.boxes.expand(len(v), 4)
    maps[0][0, :4, v, u] = encode(boxes, v, u, 4).T
    maps[0][0, 4, v, u] = 12.0
    maps[0][0, 8, v, u] = 20.0
    after = loss(maps, [t], design)
    assert after["total"] < 1e-3 < before["total"]


def test_loss_of_an_empty_picture_is_finite():
    maps = [torch.zeros(1, 10, n, n, requires_grad=True) for n in (32, 8, 4)]
    total = loss(maps, [target()], Design())["total"]
    total.backward()
    assert torch.isfinite(total)


@pytest.mark.parametrize("design", [Design(), Design(attention=False), Design(fine_map=False)])
def test_sizes(design):
    network = Detector(design).eval()
    assert parameters(network) <= 500_000
    maps = network(torch.zeros(1, 3, 416, 416))
    assert [m.shape[-1] for m in maps] == [416 // s for s in network.strides]
    assert (104 in [m.shape[-1] for m in maps]) == design.fine_map
    sum(m.sum() for m in maps).backward()
    assert all(p.grad is not None for p in network.parameters())  # nothing is built in vain


def test_the_shipped_weights_fit_and_each_improvement_has_its_parameters():
    load_weights(Detector(), WEIGHTS)
    assert {name: parameters(Detector(design)) for name, design in DESIGNS.items()} == {
        "all": 361_702,
        "without_attention": 356_262,
        "without_104_map": 349_332,
        "without_ciou": 361_702,
        "none": 346_612,
    }


def test_a_short_training_lowers_the_loss_and_resumes(tmp_path, pictures, monkeypatch):
    monkeypatch.setattr(loop, "SAVE_EVERY", 20)
    plan = Plan(steps=60, batch=8)
    train(tmp_path / "run", pictures, config, Design(), Plan(40, batch=8))
    network = train(tmp_path / "run", pictures, config, Design(), plan)
    log = [json.loads(x) for x in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    totals = [e["total"] for e in log if "total" in e]
    assert [e["step"] for e in log if "total" in e] == [20, 40, 60]
    assert totals[-1] < 0.9 * totals[0]
    save_weights(network, tmp_path / "w.npz")
    again = Detector()
    load_weights(again, tmp_path / "w.npz")
    x = torch.zeros(1, 3, 64, 64)
    torch.testing.assert_close(again.eval()(x)[0], network.eval()(x)[0])
    with pytest.raises(ValueError, match="another network"):
        load_weights(Detector(Design(attention=False)), tmp_path / "w.npz")
    with pytest.raises(ValueError, match=r"another run [(]design"):
        train(tmp_path / "run", pictures, config, Design(attention=False), plan)


class Dropping(torch.nn.Module):
    """A network with all that a resumed run must find again."""

    def __init__(self):
        super().__init__()
        self.body = torch.nn.Sequential(torch.nn.Dropout(0.5), torch.nn.Linear(4, 1))

    def forward(self, x):
        return self.body(x)


def fit_dropping(folder, plan=None, progress=lambda step, total, text: None):
    def loss_of(network, rng):
        return {"total": network(torch.from_numpy(rng.random((8, 4), np.float32))).square().mean()}

    torch.manual_seed(0)
    plan = plan or Plan(60, batch=8)
    return fit(Dropping(), folder, plan, loss_of, lambda network: {}, {}, progress)


def test_a_broken_off_training_ends_as_one_in_one_piece(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "SAVE_EVERY", 20)
    whole = fit_dropping(tmp_path / "whole").state_dict()

    def stop(step, total, text):
        if step == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_dropping(tmp_path / "broken", progress=stop)
    for name, value in fit_dropping(tmp_path / "broken").state_dict().items():
        assert torch.equal(value, whole[name])


@pytest.mark.parametrize(
    "plan, said",
    [
        (Plan(60, batch=8, seed=1), r"another run [(]seed 0, not 1"),
        (Plan(60, batch=16), r"another run [(]batch 8, not 16"),
        (Plan(40, batch=8), "has 60 steps, more than the 40 asked for"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(tmp_path, plan, said):
    fit_dropping(tmp_path)
    with pytest.raises(ValueError, match=said):
        fit_dropping(tmp_path, plan)


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.7])
def test_damaged_checkpoints_and_weights_are_named(tmp_path, kept):
    fit_dropping(tmp_path)
    checkpoint, weights = tmp_path / "checkpoint.pt", tmp_path / "w.npz"
    save_weights(Dropping(), weights)
    for path in (checkpoint, weights):
        path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(ValueError, match=r"checkpoint\.pt: damaged"):
        fit_dropping(tmp_path)
    with pytest.raises(ValueError, match=r"w\.npz: damaged"):
        load_weights(Dropping(), weights)


def test_weights_of_other_shapes_are_damaged(tmp_path):
    np.savez(tmp_path / "w.npz", **{"body.1.weight": np.zeros((2, 2)), "body.1.bias": np.zeros(1)})
    with pytest.raises(ValueError, match=r"w\.npz: damaged"):
        load_weights(Dropping(), tmp_path / "w.npz")


@pytest.mark.parametrize("fine_map", [True, False])
@pytest.mark.parametrize("side", [12, 63, 64, 127, 128, 300])
def test_every_part_has_one_map_whatever_its_size(side, fine_map):
    """Expected: that of the first limit it is below; only there are classes learnt."""
    strides = [s for s in LEVEL_SIZE if s > 4 or fine_map]
    maps = [torch.zeros(1, 10, 416 // s, 416 // s, requires_grad=True) for s in strides]
    middle = target((1, (200 - side / 2, 180, 200 + side / 2, 190)))
    loss(maps, [middle], Design(fine_map=fine_map))["total"].backward()
    learnt = [s for s, m in zip(strides, maps, strict=True) if m.grad[:, 5:].any()]
    assert learnt == [next(s for s in strides if side < LEVEL_SIZE[s])]
    assert list(LEVEL_SIZE.values()) == [64, 128, np.inf]


def test_figures_that_are_not_a_number_are_left_out():
    assert known({"precision_min": float("nan"), "map50": 0.5}) == {"map50": 0.5}


def test_second_look_learns_and_resumes(tmp_path, pictures):
    first = Detector()
    folder = tmp_path / "second"
    for steps in (20, 40):
        network = train_second_look(folder, pictures, config, first, steps, seed=0)
    log = [json.loads(x) for x in (folder / "log.jsonl").read_text().splitlines()]
    totals = [e["total"] for e in log if "total" in e]
    assert len(totals) == 2 and totals[1] < totals[0]
    assert len(log[-1]["accuracy"]) == NOTHING
    with pytest.raises(ValueError, match="another network"):
        save_weights(first, tmp_path / "w.npz")
        load_weights(network, tmp_path / "w.npz")
    assert network(torch.zeros(2, 3, 64, 64)).shape == (2, NOTHING + 1)
    assert parameters(SecondLook()) + parameters(first) <= 500_000
