"""The linear algebra of the joint solution: sparse blocks and nested dissection."""
