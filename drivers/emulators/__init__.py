"""Programs that speak a real device's protocol, so that its driver can be proved without the device."""
