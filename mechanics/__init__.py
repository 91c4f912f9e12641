"""The shared vocabulary: SE(2), polygons, the object catalogue, friction, elasticity, contact, and readings."""
