"""Exit statuses other than 0."""

FAULTY, MISTAKE, STEP_FAILED, INTERRUPTED = 1, 2, 3, 130
