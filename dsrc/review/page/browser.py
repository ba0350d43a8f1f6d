"""Script that a live page runs in the browser before viser's own.

viser tells the server nothing about the address of the page, cannot write it, leaves the focus in a dropdown after a
choice and maps all colours to paler ones. The script does these four things, and nothing of the page depends on more.
"""

LINK_ID = "review-link"
"""Id of the HTML element whose `data-link` the address bar shows."""

HONEST_COLORS = """
(()=>{const t=setInterval(()=>{const m=window.__viserMutable,s=m&&m.scene,r=s&&s.__r3f&&(s.__r3f.root||s.__r3f);
 const gl=r&&r.getState&&r.getState().gl;if(gl){gl.toneMapping=0;clearInterval(t);m.requestRender();}},20);
})();
"""
"""Switch tone mapping off: colours of lines and unlit faces are shown as they are sent."""

_LINK = """
(()=>{const post=Worker.prototype.postMessage;
Worker.prototype.postMessage=function(d,...rest){
 if(d&&(d.type==='set_server'||d.type==='retry')){
  if(d.server)this.reviewServer=d.server;
  if(this.reviewServer)d={type:'set_server',server:this.reviewServer+'/'+location.search};}
 return post.call(this,d,...rest);};
const own=['fixedDpr','darkMode','showStats','websocket'];
setInterval(()=>{const e=document.getElementById('__LINK_ID__');if(!e)return;
 const kept=new URLSearchParams(location.search),all=new URLSearchParams(e.dataset.link);
 const text=[...own.filter(k=>kept.has(k)).map(k=>k+'='+kept.get(k)),...[...all].map(([k,v])=>k+'='+v)].join('&');
 const next=text?'?'+text:location.pathname;
 if(next!==(location.search||location.pathname))history.replaceState(null,'',next);},400);
})();
""".replace("__LINK_ID__", LINK_ID)
# Safari takes a hundred changes of the address in 30 s.

_KEYS = """
(()=>{const free=()=>setTimeout(()=>{const a=document.activeElement;
 if(a&&a.getAttribute('aria-haspopup')==='listbox')a.blur();},0);
document.addEventListener('click',e=>{if(e.target.closest&&e.target.closest('[role=option]'))free();},true);
document.addEventListener('keyup',e=>{if(e.key==='Enter'||e.key==='Escape')free();},true);
document.addEventListener('keydown',e=>{
 if(e.key!=='?'||/INPUT|TEXTAREA/.test(document.activeElement.tagName))return;
 document.documentElement.dispatchEvent(new KeyboardEvent('keydown',{key:'H',code:'KeyH',bubbles:true}));},true);
})();
"""

HEAD = f"<script>{HONEST_COLORS}{_LINK}{_KEYS}</script>"
"""What a live page's head begins with."""
