import numba

from cgf.geometry.compiling import told_of_compiling


def test_the_first_call_of_a_kernel_is_told_and_no_other():
    told = []
    kernel = numba.njit(lambda value: value + 1)
    with told_of_compiling(lambda: told.append("compiling")):
        assert kernel(1) == 2
        assert kernel(2) == 3
        assert len(told) == 1
        assert kernel(0.5) == 1.5
        assert len(told) == 2
    kernel(1j)
    assert len(told) == 2
