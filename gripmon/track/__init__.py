"""One frame to a measured pose with its covariance and protection level."""
