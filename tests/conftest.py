"""What all tests share."""

import flax.struct

# The import hook checks the arrays that functions take and return. Containers hold shapes, NumPy
# arrays and JAX's own placeholders too, so they are left alone: the hook honours this mark.
flax.struct.PyTreeNode.__no_type_check__ = True
