"""The paper's tables and curves as data, and each of their rows measured on the data and weights at hand."""
