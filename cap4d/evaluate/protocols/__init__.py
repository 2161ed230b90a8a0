"""The paper's protocols: many fits and their evaluations, as tables and pictures."""
