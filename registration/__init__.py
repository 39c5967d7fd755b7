"""Registration by optimal control: what forces bring the body to an observed partial cloud."""
