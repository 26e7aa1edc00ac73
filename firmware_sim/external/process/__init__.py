"""The process of external firmware: started, ended with its parent, its working folder."""
