# SPDX-License-Identifier: Apache-2.0
from hypothesis import HealthCheck, settings

# The same examples each time, and none fails because the machine is busy.
settings.register_profile("here", deadline=None, derandomize=True, database=None, max_examples=60,
                          suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("here")
