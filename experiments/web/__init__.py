"""What all pages share: how a template is filled, the look, and how a table is shown."""
