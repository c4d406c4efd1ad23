// What Sphinx leaves out for keyboards and screen readers.
document.addEventListener("DOMContentLoaded", () => {
  // Parameters of long signatures are a list without terms.
  for (const part of document.querySelectorAll("dt.sig dl, dt.sig dd")) part.setAttribute("role", "none");
});
// Whether a part scrolls is known once fonts and style sheets are there; an observer alone first reports with a later frame.
window.addEventListener("load", () => {
  for (const part of document.querySelectorAll("pre, .table-wrapper")) {
    const reach = () => {
      if (part.scrollWidth > part.clientWidth) part.tabIndex = 0;
      else part.removeAttribute("tabindex");
    };
    reach();
    new ResizeObserver(reach).observe(part);
  }
});
