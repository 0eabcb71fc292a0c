"""A point in a plane that has several goals, or several ways to one."""
