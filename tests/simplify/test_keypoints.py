import numpy as np

from jaxsimp.simplify import KeyPoints


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
        threshold=1.0,
    )


def test_mask_is_true_exactly_at_the_key_particles():
    assert key_points([0, 3, 5]).mask.tolist() == [True, False, False, True, False, True]
    assert not key_points([]).mask.any()
    assert key_points(range(6)).mask.all()


def test_length_is_the_number_of_key_points():
    assert len(key_points([1, 4])) == 2
    assert len(key_points([])) == 0


def test_mask_selects_the_particles_of_an_action():
    action = np.arange(12.0).reshape(6, 2)
    points = key_points([1, 4])
    assert np.array_equal(action[points.mask], action[points.particles])
