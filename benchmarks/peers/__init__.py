"""Other people's learners on our settings. These modules run in .venv-peers.

Each prints a line of JSON: its environment steps per second once compiled and learning, and the
microseconds that the matrix products of one of its updates take by themselves in its own library.
"""

import json

WARM_UP = 1000  # steps: compiled and learning


def tell(steps_per_second: float, products: float) -> None:
    """The line that is read by `benchmarks.learning`."""
    print(json.dumps({"steps_per_second": steps_per_second, "products": products}))
