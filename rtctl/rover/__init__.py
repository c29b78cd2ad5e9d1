"""The mobile base on the plane: the arm's pipe with a planar model, the same goal and FIRAS field, wheels as drives."""
