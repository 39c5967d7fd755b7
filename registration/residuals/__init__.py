"""What pulls beside the cloud's distances, one file a kind of measurement: each a `ResidualTerm` with its deviation."""
