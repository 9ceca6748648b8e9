"""Forces: one file a term of the potential."""
