"""The manipulation skills of the paper, one file each. Importing this package registers them all in `base.SKILLS`."""

from planning.skills import extrinsic_pivoting as _extrinsic_pivoting
from planning.skills import extrinsic_pushing as _extrinsic_pushing
from planning.skills import grasped_pivoting as _grasped_pivoting
from planning.skills import grasped_sliding as _grasped_sliding
from planning.skills import grasped_static as _grasped_static
from planning.skills import relative_pivoting as _relative_pivoting
from planning.skills import relative_sliding as _relative_sliding
from planning.skills import static_in_contact as _static_in_contact

__all__: list[str] = []

del (
    _extrinsic_pivoting,
    _extrinsic_pushing,
    _grasped_pivoting,
    _grasped_sliding,
    _grasped_static,
    _relative_pivoting,
    _relative_sliding,
    _static_in_contact,
)
