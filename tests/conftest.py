"""What all tests share. Examples of a property may take as long as they take: the machine has other work.

Linear algebra runs on one thread, here and in the processes that tests start: two workers on two cores would otherwise
wait for each other's threads most of the time.
"""

import os

from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")
threadpool_limits(limits=1)

settings.register_profile("steady", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("steady")
