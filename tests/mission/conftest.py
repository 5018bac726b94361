"""Lets the tests of this folder import `mission_oracle`, however pytest was started."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
