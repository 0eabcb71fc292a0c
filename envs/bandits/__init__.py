"""Tasks of one step whose reward has several optima."""
