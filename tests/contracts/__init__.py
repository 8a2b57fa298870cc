"""What every transport, law and motor driver must do; each inherits its contract in its own test file."""

import pytest

# pytest explains a failed assert only in files it knows to hold tests; these are imported by such.
pytest.register_assert_rewrite("tests.contracts.link_contract")
pytest.register_assert_rewrite("tests.contracts.law_contract")
