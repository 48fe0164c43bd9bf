"""A second camera with a laser that is pulsed: which frames show a pulse, and what each pulse says."""
