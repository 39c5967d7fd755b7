"""What a registration estimates, one file a kind of parameter: each a `ParameterBlock` with prior and derivatives."""
