"""Many runs of one experiment, spread over the cores of a machine or the machines of a cluster."""
