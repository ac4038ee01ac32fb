"""Which segment shows which line, and which lines are one."""
