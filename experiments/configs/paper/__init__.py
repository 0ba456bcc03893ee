"""The paper's tables and figures, and its fields at their full size."""
