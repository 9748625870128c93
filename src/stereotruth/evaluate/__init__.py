"""How good labels and surface models are. In: these, images, exact truth. Out: figures, pages.

Also tiles with exact labels.
"""
