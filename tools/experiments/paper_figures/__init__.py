"""The paper's figures, table and claim of cost."""
