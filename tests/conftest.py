"""Settings of the whole suite."""

from __future__ import annotations

from hypothesis import settings

# A slow minute of a shared machine is no failure: no deadlines.
settings.register_profile("fwav-hil", deadline=None, print_blob=True)
settings.load_profile("fwav-hil")
