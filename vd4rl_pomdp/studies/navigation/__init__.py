"""The paper's navigation tables: which runs make them, and what finished runs say. Reads files only."""
