import pytest

from brain.bodies.joints import Joints


def test_motors_in_the_order_of_the_file() -> None:
    assert Joints(motors=("b", "a")).motors == ("b", "a")


@pytest.mark.parametrize("motors", [(), ("",), ("a", "a")])
def test_what_is_no_body_is_refused(motors: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="motors must"):
        Joints(motors=motors)
