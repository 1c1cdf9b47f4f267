import pickle
from dataclasses import replace

import numpy as np
import pytest

from jaxsimp.simplification import KeyPoints
from jaxsimp.simplification.key_points import SIZES_BEYOND, smallest_fit


def key_points(particles, num_particles=6):
    particles = np.array(particles, dtype=int)
    return KeyPoints(
        particles=particles,
        positions=np.zeros((len(particles), 3)),
        elements=np.zeros((0, 2), dtype=int),
        num_particles=num_particles,
        method="by hand",
        sizes=(len(particles),),
        errors=(0.0,),
        tolerance=1.0,
        max_error=0.0,
        rms_error=0.0,
    )


def test_mask_is_true_exactly_at_the_key_particles():
    assert key_points([0, 3, 5]).mask.tolist() == [True, False, False, True, False, True]
    assert not key_points([]).mask.any()
    assert key_points(range(6)).mask.all()


def test_arrays_are_its_own_and_read_only_also_after_unpickling():
    particles = np.array([0, 3])
    points = replace(key_points([0, 3]), particles=particles)
    particles[0] = 5
    for each in (points, pickle.loads(pickle.dumps(points))):
        assert each.particles.tolist() == [0, 3]
        with pytest.raises(ValueError, match="read-only"):
            each.particles[0] = 5
        assert each.mask.sum() == 2


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"particles": np.array([0, 6])}, "particles names 6; the ids of 6 particles are 0 to 5"),
        ({"particles": np.array([-1, 3])}, "particles names -1"),
        ({"particles": np.array([0.0, 3.0])}, "particles is an array of float64, shape .2,.; give"),
        ({"elements": np.array([[0, 2]])}, "elements names 2; the ids of 2 key points are 0 to 1"),
        (
            {"positions": np.zeros((3, 3))},
            r"positions has shape \(3, 3\); give x, y, z for each of 2",
        ),
    ],
)
def test_particles_are_ids_of_the_body(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(key_points([0, 3]), **changes)


def test_length_is_the_number_of_key_points():
    assert len(key_points([1, 4])) == 2
    assert len(key_points([])) == 0


def test_mask_selects_the_particles_of_an_action():
    action = np.arange(12.0).reshape(6, 2)
    points = key_points([1, 4])
    assert np.array_equal(action[points.mask], action[points.particles])


def test_the_smallest_fit_is_the_first_and_a_few_sizes_beyond_are_tried():
    errors = {2: 5.0, 3: 0.5, 4: 2.0, 5: 0.4, 6: 0.3, 7: 0.2, 8: 0.1}
    size, tried = smallest_fit(errors.__getitem__, errors, tolerance=1.0)
    assert size == 3  # the size of 4 that does not fit again changes nothing
    assert list(tried) == [2, 3, 4, 5, 6]
    assert len(tried) - 2 == SIZES_BEYOND


def test_no_fit_is_none_with_every_error():
    assert smallest_fit(float, range(2, 5), tolerance=1.0) == (None, {2: 2.0, 3: 3.0, 4: 4.0})


def test_a_fit_at_the_last_size_is_found():
    assert smallest_fit(lambda size: 4.0 - size, range(2, 5), tolerance=1.0)[0] == 4
