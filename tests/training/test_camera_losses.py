import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.camera.small_network import SmallOutputs  # noqa: E402
from lcf3d.training.camera_images import ABSENT  # noqa: E402
from lcf3d.training.camera_losses import (  # noqa: E402
    FLOOR,
    MOST_CELLS,
    Targets,
    assign,
    box_masks,
    cell_centres,
    generalized_iou,
    losses,
    pairwise_iou,
)

SIZE = (32, 64)
CELLS = 4 * 8 + 2 * 4 + 1 * 2


def outputs(boxes: list[list[float]] | None = None) -> SmallOutputs:
    """Every cell says 0.5 for every class and predicts a square of 16 pixels around its centre."""
    centres = cell_centres(SIZE, torch.zeros(1))
    squares = torch.cat([centres - 8, centres + 8], dim=1)[None]
    return SmallOutputs(
        torch.zeros(1, CELLS, 3, requires_grad=True),
        squares.clone().requires_grad_(),
        torch.ones(1, CELLS, 2, requires_grad=True),
        torch.zeros(1, 2, 8, 16, requires_grad=True),
    )


def targets(boxes: list[list[float]], labels: list[int], masks: bool = True) -> Targets:
    corners = torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4)
    owner = torch.zeros(1, *SIZE, dtype=torch.uint8)
    for number, (x1, y1, x2, y2) in enumerate(corners.int().tolist(), 1):
        owner[0, y1:y2, x1:x2] = number
    count = len(corners)
    # one row more than there are objects
    corners = torch.cat([corners, torch.zeros(1, 4)])[None]
    return Targets(
        corners,
        corners,
        torch.tensor([[*labels, ABSENT]], dtype=torch.int64),
        owner if masks else None,
        torch.arange(1, count + 2, dtype=torch.uint8)[None],
    )


def chosen(boxes: list[list[float]], labels: list[int]):
    wanted = targets(boxes, labels)
    return assign(outputs(), wanted, cell_centres(SIZE, torch.zeros(1)))


def test_centres_follow_the_grids() -> None:
    centres = cell_centres(SIZE, torch.zeros(1))
    assert centres.shape == (CELLS, 2)
    assert centres[[0, 1, 8, 32, 40, 41]].tolist() == [[4, 4], [12, 4], [4, 12], [8, 8], [16, 16], [48, 16]]


def test_cells_that_see_an_object_best_learn_it() -> None:
    result = chosen([[16, 8, 32, 24]], [1])
    assert 0 < int(result.owned.sum()) <= MOST_CELLS
    assert (result.objects[result.owned] == 0).all()
    # four fine cells touch the middle; each overlaps with 12 x 12 of 16 x 16 pixels, and no cell does better
    best = 144 / (2 * 256 - 144)
    assert result.quality.max().item() == pytest.approx(FLOOR + (1 - FLOOR) * best, abs=1e-5)
    assert not result.ignored.any()


def test_an_object_smaller_than_a_cell_is_learned() -> None:
    assert chosen([[17, 9, 19, 12]], [2]).owned.any()


def test_a_cell_learns_one_object_only() -> None:
    result = chosen([[16, 8, 32, 24], [18, 8, 34, 24]], [0, 0])
    assert set(result.objects[result.owned].tolist()) == {0, 1}


def test_scores_on_ignored_objects_are_not_taught() -> None:
    result = chosen([[0, 0, 64, 32]], [-1])
    assert not result.owned.any()
    assert result.ignored.all()
    answers = outputs()
    losses(answers, targets([[0, 0, 64, 32]], [-1]), SIZE)["score"].backward()
    assert (answers.logits.grad == 0).all()


def test_an_image_without_objects_teaches_low_scores_only() -> None:
    answers = outputs()
    terms = losses(answers, targets([], []), SIZE)
    assert terms["box"].item() == 0
    assert terms["mask"].item() == 0
    sum(terms.values()).backward()
    assert (answers.logits.grad > 0).all()


def test_images_of_a_batch_do_not_see_each_other() -> None:
    one, two = targets([[16, 8, 32, 24]], [0]), targets([[40, 4, 50, 28]], [1])
    tables = ("boxes", "visible", "labels", "owner", "numbers")
    both = Targets(*(torch.cat([getattr(one, name), getattr(two, name)]) for name in tables))
    single = outputs()
    maps = ("logits", "boxes", "coefficients", "prototypes")
    pair = SmallOutputs(*(torch.cat([getattr(single, name)] * 2) for name in maps))
    centres = cell_centres(SIZE, torch.zeros(1))
    together = assign(pair, both, centres)
    for row, alone in enumerate((one, two)):
        torch.testing.assert_close(together.quality[row], assign(single, alone, centres).quality[0])


def test_without_masks_there_is_no_mask_term() -> None:
    assert set(losses(outputs(), targets([[16, 8, 32, 24]], [0], masks=False), SIZE)) == {"score", "box"}


def test_losses_fall_along_their_gradient() -> None:
    wanted = targets([[16, 8, 32, 24], [40, 4, 50, 28]], [0, 1])
    answers = outputs()
    before = losses(answers, wanted, SIZE)
    sum(before.values()).backward()
    parts = (answers.logits, answers.boxes, answers.coefficients, answers.prototypes)
    moved = SmallOutputs(*((p - 0.05 * p.grad).detach() for p in parts))
    assert sum(losses(moved, wanted, SIZE).values()) < sum(before.values())


def test_overlaps_by_hand() -> None:
    a, b = torch.tensor([[0.0, 0, 4, 4]]), torch.tensor([[2.0, 0, 6, 4], [4.0, 0, 8, 4], [0.0, 0, 4, 4]])
    torch.testing.assert_close(pairwise_iou(a, b), torch.tensor([[8 / 24, 0, 1.0]]))
    torch.testing.assert_close(generalized_iou(a.expand(3, 4), b), torch.tensor([8 / 24, 0.0, 1.0]))
    far = torch.tensor([[12.0, 0, 16, 4]])
    torch.testing.assert_close(generalized_iou(a, far), torch.tensor([-0.5]))


def test_box_masks_hold_every_touched_cell() -> None:
    mask = box_masks(torch.tensor([[1.2, 0.0, 2.1, 1.0]]), (2, 4), torch.zeros(1))
    assert mask[0].tolist() == [[0, 1, 1, 0], [0, 0, 0, 0]]
