"""Exit statuses besides 0."""

FAULTY, MISTAKE, STEP_FAILED, INTERRUPTED = 1, 2, 3, 130
