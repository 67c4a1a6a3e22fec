"""What workflows draw is there or not, so that its edges may be jagged; tests/training/viz looks at pictures."""

from collections.abc import Iterator

import pytest

from training.viz.render import renderer


@pytest.fixture(scope="module", autouse=True)
def _one_sample_a_pixel() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(renderer, "_SUPERSAMPLE", 1)
        yield
