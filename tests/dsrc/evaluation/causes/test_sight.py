import numpy as np

from dsrc.evaluation.causes.sight import hidden_by
from sim.boxes import Boxes


def street(*rows: list[float]) -> Boxes:
    return Boxes.from_array(rows, object_id=10 + np.arange(len(rows)))


SENSOR = np.array([0.0, 0.0, 1.9])
CAR = [30.0, 0.0, 0.8, 4.5, 1.9, 1.6, 0.0]


def test_the_first_box_on_the_way_hides_what_is_behind_it() -> None:
    near, far = [10.0, 0.0, 1.7, 8.0, 2.5, 3.4, 0.0], [20.0, 0.0, 1.7, 8.0, 2.5, 3.4, 0.0]
    assert hidden_by(SENSOR, street(CAR, far, near), 0, 1) == 2
    assert hidden_by(SENSOR, street(CAR, far), 0, 1) == 1


def test_what_is_beside_below_behind_or_carries_the_sensor_hides_nothing() -> None:
    beside, behind = [15.0, 6.0, 1.7, 8.0, 2.5, 3.4, 0.0], [45.0, 0.0, 1.7, 8.0, 2.5, 3.4, 0.0]
    back, own = [-15.0, 0.0, 1.7, 8.0, 2.5, 3.4, 0.0], [0.5, 0.0, 0.8, 4.5, 1.9, 3.0, 0.0]
    flat = [15.0, 0.0, 0.3, 4.5, 1.9, 0.6, 0.0]
    assert hidden_by(SENSOR, street(CAR, beside, behind, back, own, flat), 0, 14) == -1
    assert hidden_by(SENSOR, street(CAR, own), 0, 1) == 1, "another's body around the sensor stands in its way"


def test_a_turned_box_is_met_where_it_stands() -> None:
    along, across = [15.0, 3.0, 1.7, 8.0, 2.0, 3.4, 0.0], [15.0, 3.0, 1.7, 8.0, 2.0, 3.4, np.pi / 2]
    assert hidden_by(SENSOR, street(CAR, along), 0, 1) == -1
    assert hidden_by(SENSOR, street(CAR, across), 0, 1) == 1
