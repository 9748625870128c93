"""How good labels are. In: labels, images, exact truth, check points. Out: figures and tables."""
