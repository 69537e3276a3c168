"""What a job will do and cost, before it does it (`--dry-run`). Imports nothing heavy."""

from typing import Any

from mistyle.core.errors import InputRefused
from mistyle.files.read import probe_picture
from mistyle.run.inputs import input_files
from mistyle.run.stages import STAGES, Job
