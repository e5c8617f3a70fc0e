"""The detector's decoding, its pictures, and, where they have been fetched, its weights."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft import template_files
from tests.examples.loading import modules
from tests.needs import need, needs

need("pillow")
with modules("detect", "ssd", "pictures", "fetch_weights") as found:
    ssd, pictures, fetch_weights = found

LABELS = ["???", "Cat", "Dog"]
WEIGHTS = template_files.folder() / "detect" / "weights"


def encoded(*objects: tuple[int, int, float, tuple[float, float, float, float]]):
    """Return what the network would say of objects: anchor, class, logit, box in pixels."""
    offsets = np.zeros((len(ssd.ANCHORS), 4), np.float32)
    logits = np.full((len(ssd.ANCHORS), len(LABELS)), -10.0, np.float32)
    for index, label, logit, (x, y, wide, high) in objects:
        at_y, at_x, tall, broad = ssd.ANCHORS[index]
        centre_y, centre_x = (y + high / 2) / 480, (x + wide / 2) / 640
        offsets[index] = (
            (centre_y - at_y) / tall * 10,
            (centre_x - at_x) / broad * 10,
            np.log(high / 480 / tall) * 5,
            np.log(wide / 640 / broad) * 5,
        )
        logits[index, label] = logit
    return offsets, logits


def decoded(*objects, threshold=0.5):
    return ssd.decode(*encoded(*objects), LABELS, (640, 480), threshold)


@given(
    index=st.integers(0, 1916),
    box=st.tuples(st.floats(0, 600), st.floats(0, 440), st.floats(8, 600), st.floats(8, 440)),
)
def test_a_box_comes_back_from_any_anchor(index, box):
    """Decoding is the inverse of the encoding that the network was trained with."""
    (one,) = decoded((index, 2, 3.0, box))
    assert one.label == "Dog"
    assert one.score == pytest.approx(1 / (1 + np.exp(-3)), abs=1e-4)
    assert one.box == pytest.approx(box, rel=1e-3, abs=0.2)


def test_the_surest_of_those_that_overlap_is_kept():
    near, shifted, far = (100, 100, 80, 80), (105, 102, 80, 80), (400, 300, 60, 60)
    seen = decoded((1200, 1, 2.0, near), (1300, 1, 4.0, shifted), (1400, 1, 1.0, far))
    assert [round(each.box[0]) for each in seen] == [105, 400]
    both = decoded((1200, 1, 2.0, near), (1300, 2, 4.0, shifted))
    assert [each.label for each in both] == ["Dog", "Cat"]


def test_what_is_unsure_is_left_out():
    assert decoded((5, 1, 0.0, (10, 10, 50, 50)), threshold=0.51) == []
    assert len(decoded((5, 1, 0.0, (10, 10, 50, 50)), threshold=0.49)) == 1


def test_pictures_are_new_each_time_and_their_boxes_are_within():
    chance = random.Random(1)
    drawn = [pictures.picture(chance) for _ in range(30)]
    assert {each.label for each in drawn} == set(pictures.LABELS)
    assert len({each.jpeg() for each in drawn}) == 30
    for each in drawn:
        x, y, wide, high = each.box
        assert x >= 0
        assert y >= 0
        assert (x + wide, y + high) <= pictures.SIZE


def test_files_are_cut_out_of_the_packed_ones():
    """By the names and places in the index, and only those that are wanted."""
    names = list(fetch_weights.WANTED)
    index = (
        f'[{{"filename": "/a/{names[1]}", "start": 2, "end": 5}},'
        f'{{"filename": "/a/{names[0]}", "start": 5, "end": 6}},'
        '{"filename": "/a/other", "start": 0, "end": 2}]'
    )
    assert fetch_weights.unpacked(index, b"xxabcd") == {names[1]: b"abc", names[0]: b"d"}


def test_other_weights_are_not_taken_for_the_right_ones(tmp_path):
    for name, _ in fetch_weights.WANTED.values():
        (tmp_path / name).write_text("other")
    assert not fetch_weights.present(tmp_path)


@needs("weights", "litert")
def test_what_was_drawn_is_found_where_it_was_drawn():
    detector, chance = ssd.Detector(WEIGHTS), random.Random(2)
    for _ in range(20):
        drawn = pictures.picture(chance)
        best = detector.detect(np.asarray(drawn.image), 0.4)[0]
        assert best.label == drawn.label
        assert ssd.overlap(best.box, drawn.box) > 0.5
    blank = np.full((480, 640, 3), 128, np.uint8)
    assert detector.detect(blank, 0.4) == []
