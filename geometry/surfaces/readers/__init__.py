"""One file per format of surfaces; each gives the polygons that the file holds, none of which is lost."""
