"""Values over a rectangle, as the ground of a picture on which all colours are seen."""

import numpy as np
from jaxtyping import Float, Float32

HEADS = "turbo"  # the colours of heads


def grid(low, high, across: int) -> Float32[np.ndarray, "across across 2"]:
    """Points of a rectangle between two corners, the first axis upwards."""
    return np.stack(np.meshgrid(*np.linspace(low, high, across, dtype=np.float32).T), -1)


def light_greys():
    """A map of colours."""
    from matplotlib.colors import LinearSegmentedColormap  # slow to import

    return LinearSegmentedColormap.from_list("light greys", ["0.55", "1.0"])


def draw_map(
    figure, axes, values: Float[np.ndarray, "Y X"], extent: tuple[float, ...], label: str
) -> None:
    """Greys and contours on Matplotlib's `axes`; nan stays white.

    Args:
      extent: left, right, bottom and top edge.
      label: of the values.
    """
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    flat = high - low <= 1e-3 * max(abs(low), abs(high))  # little but rounding to show
    limits = (low - 1, high + 1) if flat else (low, high)
    image = axes.imshow(
        values,
        origin="lower",
        extent=extent,
        cmap=light_greys(),
        vmin=limits[0],
        vmax=limits[1],
    )
    if not flat:
        axes.contour(values, 10, extent=extent, colors="0.4", linewidths=0.5, linestyles="solid")
    figure.colorbar(image, ax=axes, label=label, shrink=0.85, format="%.4g")
