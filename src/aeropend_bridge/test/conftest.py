# SPDX-License-Identifier: Apache-2.0
from hypothesis import HealthCheck, settings

# No example fails, and no strategy is too slow, because the machine is busy.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
