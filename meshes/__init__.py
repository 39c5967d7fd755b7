"""Bodies: shapes, surfaces made solid, files, embedding, point clouds, measures of error."""
