"""Images as they are delivered: RPCs, files, dates and suns; how the images of a pair look."""
