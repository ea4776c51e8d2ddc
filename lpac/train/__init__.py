"""From a configuration to a policy: generate, fit, DAgger rounds, select, export."""
