"""What residuals tell: noise, outliers, correlation, smoothness, posterior."""
