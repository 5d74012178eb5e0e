"""How exact? Errors of models, of the tracer and of inverse maps against references."""
