"""The manipulation skills of the paper, one file each. Importing this package registers them all in `base.SKILLS`."""

from planning.skills import grasped_pivoting as _grasped_pivoting
from planning.skills import grasped_static as _grasped_static

__all__: list[str] = []

del _grasped_pivoting, _grasped_static
